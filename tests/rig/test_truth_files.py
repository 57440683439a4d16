"""Only what the virtual rig wrote gives way to a new recording; a folder of somebody else stays as it is."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from helpers import changed, write_block_robot, write_small_recording
from rig_scripts import SCRIPT

from femsense.core.errors import InputError
from femsense.io.files import folder_hash
from femsense.io.robot_toml import load_robot
from femsense.rig.simulate import simulate
from femsense.rig.truth_files import check_place

CLOUDS = changed(SCRIPT, {"contacts": [], "clouds": {"kind": "ply"}})


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("rig")
    return simulate(load_robot(write_block_robot(root / "robot")), CLOUDS, root / "recording")


@pytest.fixture
def recording(simulated: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(simulated, tmp_path / "recording"))


def test_what_the_rig_wrote_gives_way(recording: Path) -> None:
    assert list(recording.rglob("*.ply"))
    (recording / ".unfinished").write_bytes(b"")
    check_place(recording)
    check_place(recording.parent / "new")
    (recording.parent / "empty").mkdir()
    check_place(recording.parent / "empty")


@pytest.mark.parametrize(
    "name", ["notes.txt", "thesis/ch1.tex", "import.json", "clouds/mine.ply", "truth/mine.csv", "states.npz"]
)
def test_files_beside_are_never_deleted(recording: Path, name: str) -> None:
    mine = recording / name
    mine.parent.mkdir(exist_ok=True)
    mine.write_text("mine")
    robot = load_robot(write_block_robot(recording.parent / "robot"))
    with pytest.raises(InputError, match=r"other files in the folder would be deleted\n  found:    " + name):
        simulate(robot, CLOUDS, recording)
    assert mine.read_text() == "mine"


def test_a_link_into_another_folder_is_a_file_beside(recording: Path) -> None:
    (recording / "pictures").symlink_to(recording.parent)
    with pytest.raises(InputError, match="found:    pictures"):
        check_place(recording)


@pytest.mark.parametrize("truth", [None, '{"format": "other"}', "none"])
def test_a_recording_of_a_real_robot_is_never_deleted(tmp_path: Path, truth: str | None) -> None:
    recording = write_small_recording(tmp_path / "real")
    if truth is not None:
        (recording / "truth").mkdir()
        (recording / "truth" / "truth.json").write_text(truth)
    before = folder_hash(recording)
    robot = load_robot(write_block_robot(tmp_path / "robot"))
    with pytest.raises(InputError, match="not a simulated one and would be deleted"):
        simulate(robot, CLOUDS, recording)
    assert folder_hash(recording) == before
