"""Programs in a process of their own: what they make, and what is said where they do not."""

from __future__ import annotations

from pathlib import Path

import pytest

from femsense.io.meshing.child_process import ProgramFailed, ProgramTimeout, run_program

WRITES = "import sys; open('made.txt', 'w').write(sys.argv[1])"


def test_a_program_runs_in_its_folder_and_makes_a_file(tmp_path: Path) -> None:
    made = run_program(WRITES, "words", folder=tmp_path, makes="made.txt", seconds=60)
    assert made == tmp_path / "made.txt" and made.read_text() == "words"


@pytest.mark.parametrize(
    ("program", "said"),
    [("raise ValueError('no surface')", "no surface"), ("import os; os._exit(3)", "status 3"), ("pass", "status 0")],
)
def test_one_that_fails_says_its_last_line(program: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(ProgramFailed, match=said):
        run_program(program, folder=tmp_path, makes="made.txt", seconds=60)


def test_one_that_makes_a_file_and_crashes_has_failed(tmp_path: Path) -> None:
    with pytest.raises(ProgramFailed, match="status 5"):
        run_program(f"{WRITES}; import os; os._exit(5)", "words", folder=tmp_path, makes="made.txt", seconds=60)


def test_one_that_does_not_end_is_stopped(tmp_path: Path) -> None:
    with pytest.raises(ProgramTimeout):
        run_program("while True: pass", folder=tmp_path, makes="made.txt", seconds=0.3)
