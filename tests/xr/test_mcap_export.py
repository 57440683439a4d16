"""A run as MCAP, read back by two readers that share nothing with the writer's definitions."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from small_run import write_run_with_a_cloud

from femsense.core.errors import MissingDependency
from femsense.fem.mesh import surface_triangles
from femsense.sensing.types import Run
from femsense.xr.mcap_export import export_mcap

pytest.importorskip("mcap_ros2")


@pytest.fixture
def made(tmp_path: Path) -> tuple[Path, Run, np.ndarray]:
    return write_run_with_a_cloud(tmp_path)


def messages(file: Path) -> dict[str, list[tuple[int, object]]]:
    from mcap_ros2.reader import read_ros2_messages

    found: dict[str, list[tuple[int, object]]] = {}
    for message in read_ros2_messages(str(file)):
        found.setdefault(message.channel.topic, []).append((message.log_time_ns, message.ros_msg))
    return found


def test_what_foxglove_shows(made: tuple[Path, Run, np.ndarray], tmp_path: Path) -> None:
    folder, run, points = made
    report = export_mcap(folder, tmp_path / "run.mcap")
    assert (report.frames, report.clouds, report.contacts) == (3, 1, 3)
    found = messages(tmp_path / "run.mcap")
    assert set(found) == set(report.topics)
    at, poses = found["/femsense/contacts"][1]
    assert at == 500_000_000 and len(poses.poses) == 2
    for pose, contact in zip(poses.poses, run.contacts[:2]):
        np.testing.assert_allclose([pose.position.x, pose.position.y, pose.position.z], contact.position_m)
    force = found["/femsense/force_0"][1][1]
    np.testing.assert_allclose([force.wrench.force.x, force.wrench.force.y, force.wrench.force.z], run.contacts[2].force_n_xyz)
    assert force.header.frame_id == "contact_0" and force.header.stamp.sec == 1
    state = found["/femsense/inputs"][1][1]
    assert dict(zip(state.name, state.effort)) == {"top": 1.0, "side": 0.25}
    cloud = found["/femsense/cloud"][0][1]
    rows = np.frombuffer(bytes(cloud.data), dtype=[("xyz", "<f4", 3), ("rgb", "<u4")])
    np.testing.assert_array_equal(rows["xyz"].astype(float), points)
    assert set(rows["rgb"]) == {0xFF0033}


def test_the_deformed_body_and_arrows(made: tuple[Path, Run, np.ndarray], tmp_path: Path) -> None:
    from scipy.spatial.transform import Rotation

    folder, run, _ = made
    export_mcap(folder, tmp_path / "run.mcap")
    scene = messages(tmp_path / "run.mcap")["/femsense/scene"][2][1]
    body, forces = scene.entities
    mesh = body.triangles[0]
    points = np.array([[p.x, p.y, p.z] for p in mesh.points])
    wanted = np.asarray(run.states.nodes_m[2], dtype=float)[surface_triangles(run.robot.body.mesh)]
    np.testing.assert_allclose(points[np.array(mesh.indices).reshape(-1, 3)], wanted, atol=1e-7)
    arrow, contact = forces.arrows[0], run.contacts[2]
    q, p = arrow.pose.orientation, arrow.pose.position
    along = Rotation.from_quat([q.x, q.y, q.z, q.w]).apply([1, 0, 0])
    np.testing.assert_allclose(along, contact.force_n_xyz / np.linalg.norm(contact.force_n_xyz), atol=1e-9)
    tip = np.array([p.x, p.y, p.z]) + along * (arrow.shaft_length + arrow.head_length)
    np.testing.assert_allclose(tip, contact.position_m, atol=1e-9)


def test_ros_readers_know_the_messages(made: tuple[Path, Run, np.ndarray], tmp_path: Path) -> None:
    """`rosbags` decodes them with the definitions of ROS 2 Humble, not with those in the file."""
    highlevel, typesys = pytest.importorskip("rosbags.highlevel"), pytest.importorskip("rosbags.typesys")
    export_mcap(made[0], tmp_path / "run.mcap")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    seen = set()
    with highlevel.AnyReader([tmp_path / "run.mcap"]) as reader:
        for connection, _, raw in reader.messages():
            seen.add(connection.msgtype)
            if connection.msgtype in store.fielddefs:
                store.deserialize_cdr(raw, connection.msgtype)
    assert {"sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/WrenchStamped", "foxglove_msgs/msg/SceneUpdate"} <= seen


def test_a_missing_package_gives_the_line_that_installs_it(
    made: tuple[Path, Run, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mcap_ros2.writer", None)
    with pytest.raises(MissingDependency, match=r"femsense\[mcap\]"):
        export_mcap(made[0], tmp_path / "run.mcap")
    assert not (tmp_path / "run.mcap").exists()
