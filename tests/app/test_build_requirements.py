"""A wheel's build compiles kernels by a calibration and an estimate: what these import is there by `build-system.requires`."""

from __future__ import annotations

import csv
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, packages_distributions, requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
DEMO = ROOT / "meshes/four-leg/recordings/demo"
FRAMES = ("0", "5", "10", "15", "40")
"""Free ones, and one in which a finger presses."""
AS_IN_THE_BUILD = """
import sys
absent = set(sys.argv[1].split(","))
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in absent:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
from femsense.app.cli import run
sys.exit(run(sys.argv[2:]))
"""


def closure(names: list[str]) -> set[str]:
    """Names of packages that these requirements install, with all that they require in turn."""
    found: set[str] = set()
    ahead = [(Requirement(name), "") for name in names]
    while ahead:
        requirement, extra = ahead.pop()
        name = canonicalize_name(requirement.name)
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": extra}):
            continue
        if name in found and not requirement.extras:
            continue
        found.add(name)
        try:
            further = requires(name) or []
        except PackageNotFoundError:
            continue
        ahead += [(Requirement(text), extra) for text in further for extra in (requirement.extras or {""})]
    return found


def few_frames(folder: Path) -> Path:
    """Write the demo's recording with a few of its frames."""
    folder.mkdir()
    for name in ("frames.csv", "markers.csv"):
        with (DEMO / name).open(newline="") as file:
            head, *rows = csv.reader(file)
        with (folder / name).open("w", newline="") as file:
            csv.writer(file).writerows([head, *(row for row in rows if row[0] in FRAMES)])
    (folder / "recording.toml").write_bytes((DEMO / "recording.toml").read_bytes())
    (folder / "clouds").symlink_to(DEMO / "clouds")
    return folder


def test_calibrate_and_estimate_import_what_the_build_requires(tmp_path: Path) -> None:
    required = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["build-system"]["requires"]
    there = closure(required) | {"femsense"}
    absent = [
        module for module, owners in packages_distributions().items() if there.isdisjoint(canonicalize_name(x) for x in owners)
    ]
    assert "pytest" in absent and "numpy" not in absent
    words = ["estimate", "four-leg", few_frames(tmp_path / "recording"), "-o", tmp_path / "run"]
    done = subprocess.run(
        [sys.executable, "-c", AS_IN_THE_BUILD, ",".join(absent), *map(str, words)], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
