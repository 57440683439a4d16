"""Physical ranges of recordings and robots: what is doubted, with its likely cause, and that nothing plausible is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import block_mesh, write_block_robot

from femsense.core.arrays import FloatArray, freeze
from femsense.core.pose import invert_pose, make_pose, rotation_from_vector, transform_points
from femsense.fem.body import BodyModel, make_body, tie_cable
from femsense.fem.mesh import TetMesh, to_quadratic
from femsense.io.robot_toml import load_robot
from femsense.model.body_doubts import doubts_of_body
from femsense.model.camera import Camera
from femsense.model.plausibility import doubts_of_cloud_places, doubts_of_recording, lens_problem
from femsense.model.recording import Recording, make_recording
from femsense.model.recording_parts import Drives, MarkerRows, RestMarkers, Timeline, Views
from femsense.model.robot import Robot

FRAMES = 5


def recording(
    *,
    step: float = 0.05,
    tension: float | None = None,
    displacement: float | None = None,
    pressure: tuple[float, float] | None = None,
    places: FloatArray | None = None,
    names: tuple[str, ...] = (),
    pose: FloatArray | None = None,
    gravity: float | None = None,
    last_gravity: float | None = None,
    lens: Camera | None = None,
) -> Recording:
    """Return frames whose one input grows to a value, with the same markers [m] in each."""
    ramp = np.linspace(0.0, 1.0, FRAMES)[:, None]
    cables = [] if tension is None and displacement is None else ["top"]
    largest = tension if displacement is None else displacement
    low, high = pressure or (0.0, 0.0)
    kind = "tension" if displacement is None else "displacement"
    drives = Drives(
        cables,
        (largest or 0.0) * ramp if cables else np.zeros((FRAMES, 0)),
        kind,
        "absolute",
        chamber_names=["a"] if pressure else [],
        pressures=low + (high - low) * ramp if pressure else np.zeros((FRAMES, 0)),
    )
    seen = np.zeros((0, 3)) if places is None else places
    count = len(seen)
    frame, index = np.repeat(np.arange(FRAMES), count), np.tile(np.arange(count), FRAMES)
    rows = MarkerRows(names, frame, index, np.tile(seen, (FRAMES, 1)), np.zeros(len(frame), dtype=np.int64))
    views = Views(("",), (lens,), (pose,), ((None,),) * FRAMES, ((None,),) * FRAMES)
    weight = None
    if gravity is not None:
        weight = np.tile([0.0, 0.0, -gravity], (FRAMES, 1))
        weight[-1, 2] = -(last_gravity or gravity)
    return make_recording(
        Timeline(step * np.arange(FRAMES), np.arange(FRAMES), gravity=weight), drives=drives, markers=rows, views=views
    )


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"step": 50.0}, "is it in milliseconds?"),
        ({"step": 5.8e-7}, "is it in days or hours?"),
        ({"step": 1e5}, "is it in microseconds?"),
        ({"pressure": (98e3, 60e3)}, "is it absolute?"),
        ({"pressure": (1013.25, 1100.0)}, "is it absolute, and in hPa?"),
        ({"gravity": 1.0}, "is it in g?"),
        ({"gravity": 9810.0}, "is it in mm/s²?"),
        ({"gravity": 9.81, "last_gravity": 8.0}, "it keeps its length"),
        ({"pose": make_pose(np.eye(3), [0.0, 0.0, 40.0])}, "in centimetres or inches?"),
        ({"pressure": (0.0, 1.2)}, "reaches 1.2 Pa; is it in bar"),
        ({"pressure": (0.0, 120.0)}, "is it in kPa"),
        ({"pressure": (101e3, 121e3)}, "is it absolute?"),
        ({"pressure": (83e3, 90e3)}, "is it absolute?"),
        ({"pressure": (0.0, -3e5)}, "below a vacuum"),
        ({"tension": 250.0}, "milliampere of a motor?"),
        ({"tension": 5e-4}, "is it in kN?"),
        ({"displacement": 20.0}, "in millimetres?"),
        ({"displacement": 1.2}, "in millimetres or radians of a motor?"),
        ({"displacement": 2048.0}, "in ticks or degrees of a motor?"),
        ({"displacement": -0.02}, "is the sign right?"),
        ({"pose": make_pose(np.eye(3), [0.0, 0.0, 250.0])}, "250 m away; is its translation in millimetres?"),
    ],
)
def test_what_is_hardly_meant_is_doubted_with_its_cause(given: dict, said: str) -> None:
    doubts = doubts_of_recording(recording(**given))
    assert len(doubts) == 1 and said in doubts[0]


@pytest.mark.parametrize(
    "given",
    [
        {"step": 1 / 1000},
        {"step": 2.0},
        {"pressure": (0.0, 2e3)},
        {"pressure": (0.0, 3e5)},
        {"pressure": (0.0, -8e4)},
        {"pressure": (95e3, 0.0)},
        {"gravity": 9.81},
        {"gravity": 1.62},
        {"pressure": (0.0, 0.0)},
        {"tension": 0.02},
        {"tension": 60.0},
        {"displacement": 0.12},
        {"pose": make_pose(np.eye(3), [0.0, 0.0, 3.0])},
    ],
)
def test_what_robots_do_is_not_doubted(given: dict) -> None:
    assert doubts_of_recording(recording(**given)) == []


@pytest.mark.parametrize(
    ("numbers", "distortion", "said"),
    [
        ((131, 131, 79.5, 59.5), [0.1, -0.2, 0, 0, 0], None),
        ((131, -131, 79.5, 59.5), [0.0], "upwards"),
        ((1.3, 131, 79.5, 59.5), [0.0], "another unit than pixels"),
        ((131, 131, 319.5, 239.5), [0.0], "640 × 480"),
        ((131, 131, 79.5, 59.5), [160.0, 120.0, 0, 0, 0], "distortion of 160"),
        ((131, 131, 79.5, 59.5), [12.0, 2.0, 0, 0, 1.0, 13.0, 5.0, 0.5], None),
    ],
)
def test_lenses_against_the_size_of_images(numbers: tuple[float, ...], distortion: list[float], said: str | None) -> None:
    problem = lens_problem(160, 120, numbers, distortion)
    assert (problem is None) if said is None else (problem is not None and said in problem)


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ((525.0, 131.0, 79.5, 59.5), "nearly square"),
        ((131.0, 131.0, 40.0, 59.5), None),
        ((131.0, 131.0, 59.5, 110.0), "far from the middle"),
        ((131.0, 175.0, 79.5, 59.5), None),
    ],
)
def test_unusual_lenses_are_doubted(numbers: tuple[float, ...], said: str | None) -> None:
    fx, fy, cx, cy = numbers
    doubts = doubts_of_recording(recording(lens=Camera("", 160, 120, fx, fy, cx, cy, freeze(np.zeros(5)), 0.001)))
    assert (doubts == []) if said is None else (len(doubts) == 1 and said in doubts[0])


@pytest.mark.parametrize(
    ("shift", "std", "said"), [(0.0, 1e-4, None), (0.5, 1e-4, "same camera frame"), (0.0, 0.2, "column std_m")]
)
def test_markers_at_rest_beside_those_of_the_frames(shift: float, std: float, said: str | None) -> None:
    places = np.array([[0.0, 0.0, 0.4], [0.1, 0.0, 0.4], [0.1, 0.05, 0.4], [0.0, 0.05, 0.42]])
    rest = RestMarkers(
        ("a", "b", "c", "d"), freeze(places + np.array([shift, 0.0, 0.0])), freeze(np.full(4, std)), freeze(np.zeros(4), np.int64)
    )
    doubts = doubts_of_recording(replace(recording(places=places, names=("a", "b", "c", "d")), rest=rest))
    assert (doubts == []) if said is None else (len(doubts) == 1 and said in doubts[0])


@pytest.mark.parametrize(("shift", "said"), [(-0.5, "behind the camera"), (0.03, "nearer than depth cameras see"), (0.4, None)])
def test_clouds_behind_or_on_the_camera(shift: float, said: str | None) -> None:
    points = np.random.default_rng(0).uniform(-0.01, 0.01, (50, 3)) + np.array([0.0, 0.0, shift])
    doubts = doubts_of_cloud_places(points, "clouds")
    assert (doubts == []) if said is None else (len(doubts) == 1 and said in doubts[0])


# Poses


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return load_robot(write_block_robot(tmp_path_factory.mktemp("robot")))


POSE = make_pose(rotation_from_vector([2.0, 0.5, -0.3]), [0.1, -0.4, 0.5])
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def in_millimetres(T: FloatArray) -> FloatArray:
    return make_pose(T[:3, :3], 1e3 * T[:3, 3])


@pytest.mark.parametrize(
    ("written", "said"),
    [
        (invert_pose, "the inverse (T_camera_robot)"),
        (in_millimetres, "a translation in millimetres"),
        (lambda T: T @ FLIP, "OpenGL's axes (y up, z backwards)"),
        (lambda T: make_pose(T[:3, :3].T, T[:3, 3]), "a transposed rotation"),
        (lambda T: in_millimetres(invert_pose(T)), "with its translation in millimetres"),
        (lambda T: FLIP @ invert_pose(T), "view matrix"),
        (lambda T: T, None),
    ],
)
def test_a_pose_that_is_written_otherwise_is_named(
    written: Callable[[FloatArray], FloatArray], said: str | None, robot: Robot
) -> None:
    places = transform_points(invert_pose(POSE), robot.marker_points)
    given = recording(places=places, names=robot.marker_names, pose=written(POSE))
    doubts = [doubt for doubt in doubts_of_recording(given, robot) if "puts the markers" in doubt]
    assert (doubts == []) if said is None else (len(doubts) == 1 and said in doubts[0] and "is it that?" in doubts[0])


def test_a_camera_within_the_body_is_doubted(robot: Robot) -> None:
    middle = robot.body.mesh.nodes.mean(axis=0)
    given = recording(places=robot.marker_points - middle, names=robot.marker_names, pose=make_pose(np.eye(3), middle))
    assert any("puts the camera into the body" in doubt for doubt in doubts_of_recording(given, robot))


# Bodies


def body(mesh: TetMesh, *, ratio: float = 0.45, path: list[list[float]] | None = None) -> BodyModel:
    clamped = np.flatnonzero(mesh.nodes[:, 0] < 1e-9)
    cables = (tie_cable(mesh, "top", path, [-0.01, 0.015, 0.03]),) if path else ()
    return make_body(mesh, young_modulus=1e5, poisson_ratio=ratio, density=1e3, clamped=clamped, cables=cables)


def test_a_ratio_near_one_half_is_doubted() -> None:
    assert "0.499999" in doubts_of_body(body(block_mesh(), ratio=0.499999))[0]
    assert doubts_of_body(body(block_mesh(), ratio=0.499)) == []


def cracked() -> TetMesh:
    """Return two blocks on each other that share their nodes in the first half of their length only."""
    low, high = block_mesh((4, 2, 2)), block_mesh((4, 2, 2), start=(0.0, 0.0, 0.03))
    shift = len(low.nodes)
    number = np.arange(shift, shift + len(high.nodes))
    for k, point in enumerate(high.nodes):
        same = np.flatnonzero(np.linalg.norm(low.nodes - point, axis=1) < 1e-9)
        number[k] = same[0] if len(same) and point[0] < 0.06 else number[k]
    tets = np.vstack([low.tets, number[high.tets]])
    nodes = np.vstack([low.nodes, high.nodes])
    used, inverse = np.unique(tets, return_inverse=True)
    return TetMesh(nodes[used], inverse.reshape(tets.shape))


def test_nodes_that_lie_on_each_other_without_being_joined_are_a_crack() -> None:
    doubts = doubts_of_body(body(to_quadratic(cracked())))
    assert len(doubts) == 1 and "6 corner nodes (20 nodes of the quadratic mesh)" in doubts[0]
    assert doubts_of_body(body(to_quadratic(block_mesh((4, 2, 4), (0.1, 0.03, 0.06))))) == []


def test_a_cable_that_doubles_back_is_doubted() -> None:
    far_first = [[0.09, 0.015, 0.03], [0.05, 0.015, 0.03], [0.01, 0.015, 0.03]]
    assert doubts_of_body(body(block_mesh(), path=far_first)) == []
    doubts = doubts_of_body(body(block_mesh(), path=far_first[::-1]))
    assert len(doubts) == 1 and "turns by 180°" in doubts[0] and "is its far end first?" in doubts[0]
    exchanged = doubts_of_body(body(block_mesh(), path=[far_first[1], far_first[0], far_first[2]]))
    assert len(exchanged) == 1 and "doubles back" in exchanged[0]


def test_limits_and_moduli_in_another_unit_are_doubted() -> None:
    stiff = make_body(block_mesh(), young_modulus=150e9, poisson_ratio=0.45, density=1e3, clamped=[0, 1, 2])
    assert "stiffer than any soft robot" in doubts_of_body(stiff)[0]
    soft = make_body(block_mesh(), young_modulus=1200.0, poisson_ratio=0.45, density=1.07, clamped=[0, 1, 2])
    assert [text.partition(":")[0] for text in doubts_of_body(soft)] == ["material.young_modulus_pa", "material.density_kg_m3"]
    mesh = block_mesh()
    cable = tie_cable(mesh, "top", [[0.05, 0.015, 0.03]], [-0.01, 0.015, 0.03], max_tension=5000.0)
    pulled = make_body(mesh, young_modulus=1e5, poisson_ratio=0.45, density=1e3, clamped=[0, 1, 2], cables=(cable,))
    assert "max_tension_n of 5000 N; is it in mN or gf?" in doubts_of_body(pulled)[0]


def test_a_robot_that_is_loaded_says_its_doubts(tmp_path: Path) -> None:
    folder = write_block_robot(tmp_path, material__poisson_ratio=0.499999)
    with pytest.warns(UserWarning, match=r"robot\.toml: material\.poisson_ratio: 0\.499999"):
        load_robot(folder)
