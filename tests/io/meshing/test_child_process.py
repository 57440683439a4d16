"""Programs in a process of their own: what they make, and what is said where they do not."""

from __future__ import annotations

import numpy as np
import pytest

from femsense.io.meshing.child_process import ProgramFailed, ProgramTimeout, run_program

DOUBLES = "import sys; import numpy as np; np.savez('made.npz', twice=int(sys.argv[1]) * np.load('given.npz')['once'])"
FEW = {"once": np.arange(3.0)}


def test_a_program_finds_its_arrays_and_makes_others() -> None:
    made = run_program(DOUBLES, "2", seconds=60, given=FEW)
    assert list(made) == ["twice"] and made["twice"].tolist() == [0.0, 2.0, 4.0]


@pytest.mark.parametrize(
    ("program", "said"),
    [("raise ValueError('no surface')", "no surface"), ("import os; os._exit(3)", "status 3"), ("pass", "status 0")],
)
def test_one_that_fails_says_its_last_line(program: str, said: str) -> None:
    with pytest.raises(ProgramFailed, match=said):
        run_program(program, seconds=60)


def test_one_that_makes_a_file_and_crashes_has_failed() -> None:
    with pytest.raises(ProgramFailed, match="status 5"):
        run_program(f"{DOUBLES}; import os; os._exit(5)", "2", seconds=60, given=FEW)


def test_one_that_does_not_end_is_stopped() -> None:
    with pytest.raises(ProgramTimeout):
        run_program("while True: pass", seconds=0.3)
