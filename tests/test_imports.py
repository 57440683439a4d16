"""The direction of imports, what is imported when, and the public names."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import femsense

PACKAGE = Path(femsense.__file__).parent
LAYERS = (
    ("errors", "arrays", "pose", "parallel"),
    ("fem", "pointcloud", "qp"),
    ("model",),
    ("effects",),
    ("surface",),
    ("files", "tables", "meshfile", "quality", "frames", "frame_clouds", "robot", "recording", "materials", "regions", "keep"),
    ("march", "patch", "meshing"),
    ("calib", "xr", "rig"),
    ("sensing", "loop", "importers", "learn", "stream"),
    ("accuracy",),
    ("results", "inspection", "report", "doctor", "summary", "truth", "picture"),
    ("steps", "demo"),
    ("cli",),
    ("__main__",),
)
"""Each sees its own layer and those before it, none after it."""
STRANGERS = {"fem", "pointcloud", "qp"}
"""None of these sees another: they take arrays."""
HEAVY = {"open3d", "cv2", "trimesh", "matplotlib", "mpl_toolkits", "pytetwild", "pyvista"}
"""Imported inside the functions that use them."""
FILES = sorted(file for file in PACKAGE.rglob("*.py") if "viewer" not in file.parts and file.name != "__init__.py")
NAMES = [file.relative_to(PACKAGE).as_posix() for file in FILES]


def part_of(file: Path) -> str:
    """Return the part of the package that a file belongs to: the name of its folder, or its own."""
    return file.relative_to(PACKAGE).with_suffix("").parts[0]


def layer_of(part: str) -> int:
    return next((i for i, layer in enumerate(LAYERS) if part in layer), -1)


def imported_modules(tree: ast.AST) -> Iterator[str]:
    """Yield the full names of what a tree imports, anywhere in it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module == "femsense":
            yield from (f"femsense.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            yield node.module


def without_functions(tree: ast.AST) -> ast.AST:
    """Return a tree without the bodies of functions and of `if TYPE_CHECKING:`: what runs when the module is imported."""

    class Cut(ast.NodeTransformer):
        def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
            return None

        def visit_If(self, node: ast.If) -> ast.AST | None:
            return None if ast.unparse(node.test) == "TYPE_CHECKING" else self.generic_visit(node)

    return Cut().visit(tree)


def parse(file: Path) -> ast.AST:
    return ast.parse(file.read_text(encoding="utf-8"))


@pytest.mark.parametrize("file", FILES, ids=NAMES)
def test_imports_go_in_one_direction(file: Path) -> None:
    part = part_of(file)
    assert layer_of(part) >= 0, f"{part} has no place in LAYERS of this test"
    for module in imported_modules(parse(file)):
        if not module.startswith("femsense."):
            continue
        other = module.split(".")[1]
        assert layer_of(other) >= 0, f"{other} has no place in LAYERS of this test"
        assert layer_of(other) <= layer_of(part), f"{part} imports {other}, which stands above it"
        assert part == other or not {part, other} <= STRANGERS, f"{part} sees {other}: they take arrays and nothing of each other"


@pytest.mark.parametrize("file", FILES, ids=NAMES)
def test_heavy_modules_are_imported_where_they_are_used(file: Path) -> None:
    found = {module.split(".")[0] for module in imported_modules(without_functions(parse(file)))} & HEAVY
    assert not found


def test_the_rules_are_seen_to_be_broken() -> None:
    source = "import open3d.t\nfrom femsense import cli\ndef f():\n    import cv2\n    from femsense.qp.solve import x\n"
    assert list(imported_modules(ast.parse(source))) == ["open3d.t", "femsense.cli", "cv2", "femsense.qp.solve"]
    assert list(imported_modules(without_functions(ast.parse(source)))) == ["open3d.t", "femsense.cli"]
    guarded = "if TYPE_CHECKING:\n    import trimesh\nif True:\n    import numpy\n"
    assert list(imported_modules(without_functions(ast.parse(guarded)))) == ["numpy"]


def modules_after(code: str) -> set[str]:
    """Return the modules that an interpreter of its own has loaded after some code."""
    end = "\nimport sys; print('\\n' + ' '.join(sys.modules), file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code + end], capture_output=True, text=True, check=True, cwd=PACKAGE.parent)
    return set(done.stderr.splitlines()[-1].split())


@pytest.mark.parametrize("code", ["import femsense", "from femsense.cli import run; assert run(['--help']) == 0", "from femsense.cli import run; assert run(['estimate', '--help']) == 0"])  # fmt: skip
def test_help_and_the_bare_import_load_nothing_heavy(code: str) -> None:
    assert not modules_after(code) & ({"numpy", "scipy", "numba", "rich"} | HEAVY)


# The public names


def test_every_public_name_is_there_and_says_what_it_is() -> None:
    for name in femsense.__all__:
        value = getattr(femsense, name)
        assert name == "__version__" or (value.__doc__ and name in dir(femsense)), name
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        femsense.nonsense  # noqa: B018


@pytest.mark.parametrize(
    ("name", "operands", "keywords"),
    [
        ("load_robot", ["path_or_name"], []),
        ("load_recording", ["path"], []),
        ("solve_equilibrium", ["body"], ["tension", "shortening", "nodal_forces", "start"]),
        ("compliance", ["body", "equilibrium"], ["points", "directions"]),
        ("calibrate", ["robot", "recording"], []),
        ("estimate", ["robot", "recording", "calibration"], ["at", "progress"]),
        ("improve", ["robot", "recordings"], ["validation", "effects", "without", "progress"]),
        ("export_glb", ["run", "path"], []),
    ],
)
def test_signatures(name: str, operands: list[str], keywords: list[str]) -> None:
    parameters = inspect.signature(getattr(femsense, name)).parameters
    required = [p.name for p in parameters.values() if p.default is p.empty and p.kind is not p.KEYWORD_ONLY]
    assert required == operands
    assert set(keywords) <= {p.name for p in parameters.values() if p.kind is p.KEYWORD_ONLY}
