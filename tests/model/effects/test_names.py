"""An effect is named in its own file alone; everything else asks it for what it is."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path

import pytest

import femsense
from femsense.model.effects import CALIBRATED, EFFECT_NAMES, EFFECTS, OF_BODY, OF_INPUTS

ROOT = Path(femsense.__file__).parent
OTHER_MEANINGS = {
    ("fem", "gravity"),  # an argument of a body
    ("fem", "density"),
    ("fem", "hyperelastic"),  # a kind of element
    ("io/robot_toml.py", "gravity"),  # a table of robot.toml
    ("io/importers/images/folders.py", "depth_scale"),  # a key of Open3D's lenses
    ("io/robot_body.py", "gravity"),
    ("io/robot_toml.py", "creep"),  # a property of the material
    ("io/meshing", "gravity"),  # a table of robot.toml
    ("model/recording.py", "gravity"),
    ("model/plausibility.py", "gravity"),  # columns of frames.csv
    ("rig", "gravity"),
    ("app", "gravity"),  # what the declared model has
    ("io/meshing/robot_from_line.py", "gravity"),
    ("app/demo/truth.py", "hyperelastic"),  # what the demo's truth is made with
}
"""(where, word): plain words that say something else there."""


def own_files(name: str) -> set[Path]:
    """Return the file that defines an effect."""
    effect = next(effect for effect in EFFECTS if effect.name == name)
    return {Path(inspect.getfile(effect.apply))}


def literals(file: Path) -> Iterator[tuple[int, str]]:
    """Yield the string literals of a file with their lines; docstrings and the like (statements of their own) aside."""
    tree = ast.parse(file.read_text())
    apart = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in apart:
            yield node.lineno, node.value


def means_something_else(file: Path, word: str) -> bool:
    where = file.relative_to(ROOT).as_posix()
    return any(word == other and (where == place or where.startswith(f"{place}/")) for place, other in OTHER_MEANINGS)


def test_nothing_outside_its_own_file_names_an_effect() -> None:
    own = {name: own_files(name) for name in EFFECT_NAMES}
    found = [
        f"{file.relative_to(ROOT)}:{line}: {text}"
        for file in sorted(ROOT.rglob("*.py"))
        for line, text in literals(file)
        if text in own and file not in own[text] and not means_something_else(file, text)
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("place,word", sorted(OTHER_MEANINGS))
def test_every_exception_is_needed(place: str, word: str) -> None:
    files = [ROOT / place] if place.endswith(".py") else (ROOT / place).rglob("*.py")
    assert any(text == word for file in files for _, text in literals(file))


def test_aliases_are_effects() -> None:
    assert {alias.name for effect in EFFECTS for alias in effect.aliases} <= set(EFFECT_NAMES)


def test_calibration_moves_one_effect_of_the_body_and_one_of_the_inputs() -> None:
    assert (len(OF_BODY), len(OF_INPUTS)) == (1, 1)
    assert set(CALIBRATED) == {*OF_BODY, *OF_INPUTS}
