"""Two commands never write one folder at once, and one that was killed is in nobody's way."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from femsense.core.errors import InputError
from femsense.io.folder_lock import lock_of, only_writer

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such locks")
HOLDS = "import sys, time\nfrom femsense.io.folder_lock import only_writer\nwith only_writer(sys.argv[1]):\n    print('in', flush=True)\n    time.sleep(60)\n"


def holder(folder: Path) -> subprocess.Popen[str]:
    """Return a process that works in a folder."""
    process = subprocess.Popen([sys.executable, "-c", HOLDS, str(folder)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "in\n"
    return process


def test_the_second_is_told_who_works_there_until_that_one_is_killed(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "run"
    with holder(folder) as first:
        with pytest.raises(InputError) as told, only_writer(folder):
            pass
        first.send_signal(signal.SIGKILL)
    what, found, expected, hint = str(told.value).splitlines()
    assert what == f"{folder}: another command is writing into this folder" and str(first.pid) in found
    assert expected.endswith("one command at a time") and hint.endswith("wait until it ends, or another -o")
    assert lock_of(folder).is_file()  # left behind
    with only_writer(folder):
        pass
    assert list(folder.parent.iterdir()) == []


def test_other_folders_and_links_to_this_one(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "run")
    with only_writer(tmp_path / "run"):
        with only_writer(tmp_path / "other"):
            pass
        with pytest.raises(InputError, match="another command"), only_writer(tmp_path / "link"):
            pass


def test_it_is_free_again_after_an_error_and_where_the_folder_was_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with pytest.raises(ZeroDivisionError), only_writer(folder):
        raise ZeroDivisionError
    folder.mkdir()
    with only_writer(folder):
        folder.rename(tmp_path / "old")
        folder.mkdir()
        with pytest.raises(InputError, match="another command"), only_writer(folder):
            pass
    with only_writer(folder):
        pass


def test_a_place_without_locks_keeps_nobody_out(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with only_writer(tmp_path / "file" / "run"):
        pass
