"""Frames into a folder: resuming, what stands in the way, gaps, order, and memory."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from femsense.core.errors import InputError
from femsense.io.clouds.images import read_png
from femsense.io.files import folder_hash
from femsense.io.importers.frames import Frame, Images, Source, camera_of_numbers
from femsense.io.importers.writer import RECORD, write_recording
from femsense.io.recording_folder import load_recording

LENS = camera_of_numbers(8, 6, (5.0, 5.0), (3.5, 2.5))


def image(number: int) -> np.ndarray:
    return np.full((6, 8), 500 + number, dtype=np.uint16)


def frames(count: int, *, stop: int | None = None) -> Iterator[Frame]:
    for k in range(count):
        if k == stop:
            raise KeyboardInterrupt
        yield Frame(
            10.0 + 0.1 * k,
            picture=lambda k=k: Images(image(k)),
            markers={"tip": (0.1, 0.0, 0.01 * k)},
            inputs={"cable_a": float(k)},
        )


def source(count: int, *, stop: int | None = None) -> Source:
    return Source(Path("camera"), lambda: frames(count, stop=stop), camera=LENS, actuation="tension")


def test_what_was_stopped_goes_on_and_ends_the_same(tmp_path: Path) -> None:
    write_recording(source(9), tmp_path / "whole", identity={"a": 1})
    with pytest.raises(KeyboardInterrupt):
        write_recording(source(9, stop=5), tmp_path / "stopped", identity={"a": 1})
    assert not (tmp_path / "stopped").exists()
    part = tmp_path / ".part-import-stopped"
    with (part / ".import-journal").open("a") as stream:
        stream.write('[10.5, {"cable_a"')  # killed in the middle of a line
    first = (part / "depth/000000.png").stat().st_mtime_ns
    write_recording(source(9), tmp_path / "stopped", identity={"a": 1})
    assert (tmp_path / "stopped/depth/000000.png").stat().st_mtime_ns == first
    for file in ("whole", "stopped"):
        (tmp_path / file / RECORD).unlink()
    assert folder_hash(tmp_path / "whole") == folder_hash(tmp_path / "stopped")
    assert not part.exists()


def test_what_was_made_from_another_is_not_continued(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        write_recording(source(9, stop=5), tmp_path / "out", identity={"a": 1})
    write_recording(source(3), tmp_path / "out", identity={"a": 2})
    assert load_recording(tmp_path / "out").frame_count == 3
    assert len(list((tmp_path / "out/depth").iterdir())) == 3


def test_gaps_and_frames_out_of_order_are_counted(tmp_path: Path) -> None:
    times = [0.0, 0.1, 0.2, 0.2, 0.15, 0.3, 0.6, 0.7]
    made = Source(Path("x"), lambda: (Frame(t, markers={"a": (t, 0, 1)}) for t in times))
    found = write_recording(made, tmp_path / "out", identity={})
    assert found["dropped_out_of_order"] == 2 and found["frames"] == 6
    assert found["gaps"] == 1 and found["frames_missing"] == 2
    assert found["longest_gap_s"] == pytest.approx(0.3) and found["rate_hz"] == pytest.approx(10)


def test_no_frames_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no frames"):
        write_recording(Source(Path("x"), lambda: iter(())), tmp_path / "out", identity={})


def test_a_picture_that_is_broken_costs_itself_only(tmp_path: Path) -> None:
    def broken() -> Images:
        raise InputError("a broken image", where="there")

    items = [
        Frame(0.0, picture=lambda: Images(image(0))),
        Frame(0.1, picture=broken),
        Frame(0.2, picture=lambda: Images(image(2))),
    ]
    made = Source(Path("x"), lambda: iter(items), camera=LENS)
    with pytest.warns(UserWarning, match="a frame keeps no picture"):
        found = write_recording(made, tmp_path / "out", identity={})
    recording = load_recording(tmp_path / "out")
    assert found["broken_pictures"] == 1 and recording.cloud_files[1] == (None,)
    np.testing.assert_array_equal(read_png(tmp_path / "out/depth/000002.png"), image(2))


def test_swapped_labels_are_named(tmp_path: Path) -> None:
    def items() -> Iterator[Frame]:
        for k in range(40):
            a, b = (0.001 * k, 0.0, 1.0), (0.001 * k, 0.05, 1.0)
            yield Frame(0.1 * k, markers={"a": b, "b": a} if k >= 20 else {"a": a, "b": b})

    with pytest.warns(UserWarning, match="a and b at frame 20"):
        found = write_recording(Source(Path("x"), items), tmp_path / "out", identity={})
    assert found["label_swaps"] == 1


def test_memory_does_not_grow_with_the_length(tmp_path: Path) -> None:
    def peak(count: int) -> int:
        big = camera_of_numbers(320, 240, (300.0, 300.0), (159.5, 119.5))

        def items() -> Iterator[Frame]:
            for k in range(count):
                yield Frame(0.1 * k, picture=lambda: Images(np.full((240, 320), 700, dtype=np.uint16)))

        tracemalloc.start()
        write_recording(Source(Path("x"), items, camera=big), tmp_path / f"out{count}", identity={})
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    peak(5)
    assert peak(200) < 1.5 * peak(20)
