"""A frame as bytes, and frames through shared memory."""

from __future__ import annotations

import os

import numpy as np
import pytest

from femsense.core.errors import InputError
from femsense.io.clouds.images import read_png
from femsense.live.frames import Image, ImageKind, Marker, RawFrame, frame_bytes, png_of, read_frame
from femsense.live.ring import Ring


def test_a_frame_comes_back_from_its_bytes() -> None:
    images = (Image(ImageKind.DEPTH, b"abc", ".png", 0), Image(ImageKind.CLOUD, b"", ".ply", 1))
    markers = (Marker("tip", (0.1, -0.2, 0.3), 1),)
    frame = RawFrame(7, 1.25, images, markers, 2.5, (1.25, 1.26), 0.004, True, (("cable_top", 0.1),))
    found = read_frame(frame_bytes(frame))
    assert [(i.kind, i.data, i.suffix, i.view) for i in found.images] == [(i.kind, i.data, i.suffix, i.view) for i in images]
    assert found.markers[0].xyz_m == (0.1, -0.2, 0.3) and found.markers[0].view == 1
    values = (found.number, found.stamp_s, found.arrived_s, found.view_stamps_s, found.exposure_s, found.contact_free)
    assert values == (7, 1.25, 2.5, (1.25, 1.26), 0.004, True) and found.inputs == (("cable_top", 0.1),)


def test_a_frame_that_is_cut_off_is_refused() -> None:
    data = frame_bytes(RawFrame(0, 0.0, (Image(ImageKind.DEPTH, b"abc"),)))
    with pytest.raises(InputError, match="truncated"):
        read_frame(data[:-1])


def test_a_depth_image_loses_nothing(tmp_path) -> None:
    depth = np.random.default_rng(0).integers(0, 65536, (5, 7)).astype(np.uint16)
    color = np.zeros((5, 7, 3), np.uint8)
    color[:, :, 0] = 200
    for name, image in (("d", depth), ("c", color)):
        (tmp_path / f"{name}.png").write_bytes(png_of(image))
    assert np.array_equal(read_png(tmp_path / "d.png"), depth)
    assert np.array_equal(read_png(tmp_path / "c.png")[:, :, ::-1], color)


def test_the_newest_frames_of_a_ring_are_read_and_older_ones_are_gone() -> None:
    name = f"femsense-test-{os.getpid()}"
    ring = Ring(10, name, is_new=True, slots=2)
    reader = Ring(10, name, is_new=False, slots=2)
    try:
        tickets = [ring.write(data) for data in (b"one", b"two", b"three")]
        assert [reader.read(ticket) for ticket in tickets] == [None, b"two", b"three"]
        assert reader.read(tickets[-1] + 1) is None
        with pytest.raises(InputError, match="larger than the ring's slots"):
            ring.write(b"x" * 11)
    finally:
        reader.close()
        ring.close()
