"""Nothing half-written, hashes that depend on content alone, numbers that read back the same."""

from __future__ import annotations

import csv
import json
import math
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from femsense.core.errors import InputError
from femsense.io.files import (
    check_target,
    file_hash,
    folder_hash,
    write_beside,
    write_csv,
    write_json,
    write_toml,
    writes_through,
)

finite = st.floats(allow_nan=False, allow_infinity=False)


def left_over(folder: Path) -> list[str]:
    return sorted(file.name for file in folder.iterdir())


def test_a_failing_block_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    target.write_text("old")
    with pytest.raises(RuntimeError), write_beside(target) as part:
        part.write_text("half")
        assert part.parent == tmp_path and part.suffix == ".txt"
        raise RuntimeError
    assert target.read_text() == "old" and left_over(tmp_path) == ["a.txt"]


def test_a_failing_block_leaves_the_old_folder_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "out"
    target.mkdir()
    (target / "old.txt").write_text("old")
    with pytest.raises(RuntimeError), write_beside(target) as part:
        part.mkdir()
        (part / "new.txt").write_text("half")
        raise RuntimeError
    assert left_over(tmp_path) == ["out"] and left_over(target) == ["old.txt"]


def test_a_folder_is_replaced_as_a_whole(tmp_path: Path) -> None:
    for name in ("first", "second"):
        with write_beside(tmp_path / "out") as part:
            part.mkdir()
            (part / name).write_text(name)
    assert left_over(tmp_path) == ["out"] and left_over(tmp_path / "out") == ["second"]


def test_json_is_strict(tmp_path: Path) -> None:
    write_json(
        tmp_path / "a.json", {"a": np.array([1.0, np.nan]), "b": np.int64(3), "c": math.inf, "d": Path("x"), "e": (True, None)}
    )
    assert json.loads((tmp_path / "a.json").read_text()) == {"a": [1.0, None], "b": 3, "c": None, "d": "x", "e": [True, None]}


@given(values=st.lists(finite, min_size=1, max_size=5))
def test_numbers_read_back_the_same(tmp_path_factory: pytest.TempPathFactory, values: list[float]) -> None:
    folder = tmp_path_factory.mktemp("numbers")
    write_csv(folder / "a.csv", ["v"], [[value] for value in values])
    write_toml(folder / "a.toml", {"v": np.array(values)})
    with (folder / "a.csv").open(newline="") as stream:
        assert [float(row["v"]) for row in csv.DictReader(stream)] == values
    assert tomllib.loads((folder / "a.toml").read_text())["v"] == values


def test_csv_cells(tmp_path: Path) -> None:
    write_csv(tmp_path / "a.csv", ["name", "x", "flag"], [["a,b", math.nan, True], ["c", None, np.float64(0.1)]])
    assert (tmp_path / "a.csv").read_bytes() == b'name,x,flag\n"a,b",,1\nc,,0.1\n'


def test_the_hash_of_a_folder_sees_content_and_names_only(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / name / "sub").mkdir(parents=True)
        (tmp_path / name / "sub" / "b").write_text("b")
        (tmp_path / name / "a").write_text("a")
    (tmp_path / "two" / ".part-123-a").write_text("unfinished")
    assert folder_hash(tmp_path / "one") == folder_hash(tmp_path / "two")
    assert file_hash(tmp_path / "one" / "a") == file_hash(tmp_path / "two" / "a")
    (tmp_path / "two" / "a").rename(tmp_path / "two" / "c")
    assert folder_hash(tmp_path / "one") != folder_hash(tmp_path / "two")
    (tmp_path / "two" / "c").rename(tmp_path / "two" / "a")
    (tmp_path / "two" / "a").write_text("A")
    assert folder_hash(tmp_path / "one") != folder_hash(tmp_path / "two")


# Devices, links, protected places


def test_links_are_followed(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    for name in ("there.json", "new.json"):
        (tmp_path / name).symlink_to(tmp_path / "real" / name)
    (tmp_path / "real" / "there.json").write_text("old")
    for name in ("there.json", "new.json"):
        write_json(tmp_path / name, [1])
        assert (tmp_path / name).is_symlink() and json.loads((tmp_path / "real" / name).read_text()) == [1]


def test_links_that_lead_to_themselves_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to(tmp_path / "a")
    for attempt in (lambda: write_json(tmp_path / "a", 1), lambda: check_target(tmp_path / "a", folder=True)):
        with pytest.raises(InputError, match="cannot be written"):
            attempt()


def test_devices_are_written_through(tmp_path: Path) -> None:
    assert writes_through("/dev/null") and writes_through("/dev/stdout") and not writes_through(tmp_path / "a")
    write_json("/dev/null", [1])
    assert Path("/dev/null").is_char_device()
    with pytest.raises(InputError, match="a device or a pipe stands where a folder is to be written"):
        check_target("/dev/null", folder=True)
    with pytest.raises(InputError, match="a device or a pipe"), write_beside("/dev/null") as part:
        part.mkdir()


def test_a_pipe_is_written_through(tmp_path: Path) -> None:
    import os
    import threading

    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    got: list[str] = []
    reader = threading.Thread(target=lambda: got.append(pipe.read_text()), daemon=True)
    reader.start()
    write_json(pipe, [1, 2])
    reader.join(timeout=20)
    assert json.loads(got[0]) == [1, 2] and pipe.is_fifo()


def test_what_is_protected_is_refused_by_its_own_name(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("old")
    (tmp_path / "a.json").chmod(0o444)
    for attempt in (lambda: write_json(tmp_path / "a.json", 1), lambda: check_target(tmp_path / "a.json", folder=False)):
        with pytest.raises(InputError, match="read-only") as error:
            attempt()
        assert "a.json" in str(error.value) and ".part-" not in str(error.value)
    assert (tmp_path / "a.json").read_text() == "old"


def test_a_folder_is_not_replaced_by_a_file_nor_the_other_way(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="a folder stands where a file is to be written") as error:
        write_json(tmp_path / "folder", 1)
    assert ".part-" not in str(error.value)
    with pytest.raises(InputError, match="a file stands where a folder"), write_beside(tmp_path / "file") as part:
        part.mkdir()
    for place in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(InputError, match="a file stands where a folder"):
            check_target(place, folder=True)
    assert left_over(tmp_path) == ["file", "folder"]
    check_target(tmp_path / "new" / "deep", folder=True)
    assert not (tmp_path / "new").exists()
