"""What is sent: bytes that other programs take apart, frames of reference, documents without dictionaries."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from streams import documented, moment, names_in, twin

from femsense.xr.stream import payloads


def test_a_pose_is_twenty_bytes_and_seven_numbers_a_bone() -> None:
    data = payloads.pose_bytes(5, 1.25, moment(0.0, x=0.3).bones)
    assert len(data) == 20 + 28 * 2 and data[:4] == b"FSP1"
    assert struct.unpack_from("<IdHH", data, 4) == (5, 1.25, 2, 0)
    assert struct.unpack_from("<7f", data, 48) == pytest.approx([0.3, 0.2, 0.1, 0, 0, 0.7071068, 0.7071068])
    assert len(payloads.pose_bytes(0, 0.0, np.zeros((12, 7), np.float32))) == 356


def test_bone_rows_are_the_matrices() -> None:
    turn = Rotation.from_rotvec([0.3, -0.2, 0.9])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn.as_matrix(), [1.0, 2.0, 3.0]
    row = payloads.bone_rows(T[None])[0]
    np.testing.assert_allclose(row[:3], [1, 2, 3])
    np.testing.assert_allclose(Rotation.from_quat(row[3:]).as_matrix(), turn.as_matrix(), atol=1e-6)


def test_unity_sees_the_mirror_image_and_turning_commutes_with_mirroring() -> None:
    rows = np.random.default_rng(0).normal(size=(5, 7)).astype(np.float32)
    rows[:, 3:] /= np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
    vector, mirror = np.array([0.1, -0.2, 0.3]), np.diag([-1.0, 1.0, 1.0])
    for row, seen in zip(rows, payloads.in_unity(rows)):
        there = Rotation.from_quat(row[3:]).apply(vector) + row[:3]
        here = Rotation.from_quat(seen[3:]).apply(mirror @ vector) + seen[:3]
        np.testing.assert_allclose(here, mirror @ there, atol=1e-6)


def plain(value: Any) -> bool:
    """Whether JsonUtility can read a value: objects with fixed keys, lists of such, numbers, texts; no null."""
    if isinstance(value, dict):
        return all(key.isidentifier() and plain(v) for key, v in value.items())
    if isinstance(value, list):
        return all(plain(v) and not isinstance(v, list) for v in value)
    return isinstance(value, str | int | float | bool)


def test_documents_say_what_is_known_and_leave_out_what_is_not() -> None:
    force = json.loads(payloads.force_bytes(9, moment(3.5, contact=True)))
    assert "contacts" not in json.loads(payloads.force_bytes(9, replace(moment(3.5), contacts=None)))
    learnt = json.loads(payloads.force_bytes(9, replace(moment(3.5), contacts=None, interval_m={"tip": 0.002})))
    assert learnt["markers"] == [{"name": "tip", "interval_m": 0.002}] and "markers" not in force
    assert payloads.header(0, 2.9999999999, "robot")["stamp"] == {"secs": 3, "nsecs": 0}
    assert force["header"] == {"seq": 9, "stamp": {"secs": 3, "nsecs": 500_000_000}, "frame_id": "robot"}
    (contact,) = force["contacts"]
    assert contact["force_n"] == {"x": 0.0, "y": 0.0, "z": -2.0} and contact["size_n"] == 2.0 and contact["std_n"] == 0.1
    assert "force_std_n" not in contact and "radius_m" not in contact
    model = json.loads(payloads.model_bytes(twin(), "robots/arm.glb"))
    assert model["schema"] == "femsense-model-1" and model["bones"][1]["position"] == pytest.approx(
        {"x": 0.0, "y": 0.0, "z": 0.1}
    )
    assert model["inputs"] == [{"name": "top", "unit": "N", "low": 0.0, "high": 5.0, "range": "declared"}]
    inputs = json.loads(payloads.inputs_bytes(0, 0.0, twin().inputs, [2.0]))
    mirror = json.loads(payloads.pose_json_bytes(0, 0.0, moment(0.0, x=0.3).bones))
    assert mirror["poses"][1]["position"]["x"] == pytest.approx(-0.3) and mirror["header"]["frame_id"] == "unity"
    for document in (force, model, inputs, mirror):
        assert plain(document)
    assert json.loads(payloads.status_bytes("stale")) == {"state": "stale", "detail": ""}


def test_what_was_never_brought_into_the_robot_s_frame_says_so() -> None:
    for frame, said in (("robot", "robot: right-handed, Z up"), ("markers", "markers: as they were measured, not the robot's")):
        assert json.loads(payloads.model_bytes(twin(frame=frame), ""))["frame"] == said
        assert json.loads(payloads.force_bytes(0, moment(0.0), frame))["header"]["frame_id"] == frame
        assert json.loads(payloads.inputs_bytes(0, 0.0, (), (), frame))["header"]["frame_id"] == frame


def test_topics_are_ours_whatever_the_robot_is_called() -> None:
    assert payloads.topic("a/b +#ä", "pose") == "femsense/a_b____/pose"
    assert payloads.split_topic("femsense/arm/pose") == ("arm", "pose")
    assert payloads.split_topic("femsense/arm") is None and payloads.split_topic("other/arm/pose") is None


@pytest.mark.parametrize("data", [b"\xff", b"[1]", b"{", b"[" * 100_000, b"{" + b" " * (1 << 20) + b"}"])
def test_garbage_is_no_document(data: bytes) -> None:
    assert payloads.read_document(data) is None


def test_documents_are_those_that_the_documentation_shows() -> None:
    vector = np.array([0.0, 0.1, 0.2])
    known = payloads.Contact(0, vector, vector, 0.01, vector, vector, 0.004, "cloud")
    frame = replace(moment(3.5), contacts=(known,), run_s=3.5)
    sent = {
        "force": payloads.force_bytes(9, frame),
        "inputs": payloads.inputs_bytes(9, 3.5, twin().inputs, (1.5,)),
        "pose_json": payloads.pose_json_bytes(9, 3.5, frame.bones),
        "status": payloads.status_bytes("stale", since_s=1764201600.5),
        "measured": payloads.measured_bytes(9, 3.5, {"tip": vector}),
    }
    for kind, payload in sent.items():
        assert names_in(json.loads(payload)) == names_in(documented(kind)), kind
