"""What free frames teach: how many points err together, what flying pixels do not say, and states that remember friction."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm import T_ROBOT_CAMERA, arm, record

from femsense.calib.calibrate import calibrate
from femsense.core.arrays import FloatArray
from femsense.core.pose import invert_pose, moved_poses, transform_points
from femsense.fem.mesh import surface_triangles, triangle_normals
from femsense.io.clouds.cloud_files import write_cloud
from femsense.model.camera import CameraNoise
from femsense.model.effects import apply_effects
from femsense.model.recording import Recording
from femsense.pointcloud.cloud import PointCloud
from femsense.sensing.law import response_std
from femsense.sensing.nuisance import (
    first_knowledge,
    learn,
    misfit,
    misfit_of,
    nuisance_columns,
    nuisance_excess,
    robust_std,
)
from femsense.sensing.pipeline import estimate
from femsense.sensing.prepare import POSE_STD, make_sensor, prepare
from femsense.sensing.row_noise import weighed
from femsense.sensing.types import Knowledge, Rows

STD = 3e-4
SAG = np.zeros((1, 4, 3))
UP, ASIDE = np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0])
FRICTION = [{"name": "cable_friction", "coefficient": 0.5}]


def knowledge() -> Knowledge:
    """Return what is known of a plate of 200 × 100 mm before a free frame is seen."""
    x, y = np.meshgrid(np.linspace(0, 0.2, 21), np.linspace(0, 0.1, 11))
    nodes = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    return first_knowledge(
        (CameraNoise("stereo", at_1m=0.002),), nodes, UP * np.ones((len(nodes), 1)), 0.22, 0.03, 1e-8 * np.eye(6)
    )


def plate_rows(window: int, seed: int = 0) -> Rows:
    """Return rows of a camera of 200 × 100 pixels whose noise is one number in each window of so many pixels a side."""
    rng = np.random.default_rng(seed)
    i, j = np.meshgrid(np.arange(200), np.arange(100), indexing="ij")
    noise = np.repeat(np.repeat(rng.normal(size=(200 // window, 100 // window)), window, axis=0), window, axis=1)
    r = noise.size
    return Rows(
        functional=lambda u: np.zeros((r, len(u))),
        residual=STD * noise.ravel(),
        std=np.full(r, STD),
        by_pose=np.zeros((r, 6)),
        place=np.column_stack([1e-3 * i.ravel(), 1e-3 * j.ravel(), np.zeros(r)]),
        way=np.zeros(r),
        count=r,
        rms=STD,
        of_clouds=True,
    )


def with_far_points(far: float) -> Rows:
    """Return rows of which every fiftieth lies so many standard deviations off, to one side."""
    rows = plate_rows(1)
    residual = rows.residual.copy()
    residual[::50] = far * STD
    return replace(rows, residual=residual)


def test_an_outlier_costs_the_same_wherever_it_lies_and_where_its_ray_meets_nothing():
    near, far = (with_far_points(z) for z in (6.0, 25.0))
    none = np.zeros((len(near.residual), 0))
    cost = misfit_of(near.residual, none, near)[0]
    assert misfit_of(far.residual, none, far)[0] == pytest.approx(cost)
    keep = np.arange(len(far.residual)) % 50 != 0
    missed = replace(far, residual=far.residual[keep], std=far.std[keep], missed=np.full((~keep).sum(), 25.0))
    assert misfit_of(missed.residual, none[keep], missed)[0] == pytest.approx(cost, rel=0.02)
    grazing = replace(missed, missed=np.full((~keep).sum(), 1.0))
    assert misfit_of(grazing.residual, none[keep], grazing)[0] < 0.9 * cost


def test_outliers_tell_nothing_near_the_answer_but_pull_before():
    rows = with_far_points(8.0)
    assert np.isinf(robust_std(rows, rows.residual, firm=True)[::50]).all()
    assert np.isfinite(robust_std(rows, rows.residual)).all()
    markers = replace(rows, of_clouds=False)
    assert np.isfinite(robust_std(markers, rows.residual, firm=True)).all()


@pytest.mark.parametrize("window", [1, 2])
def test_points_of_one_window_count_as_one(window):
    learned = learn(knowledge(), [(plate_rows(window, seed), SAG) for seed in range(3)])
    assert learned.together == pytest.approx(window**2, rel=0.25)


@pytest.mark.parametrize(("kind", "grows"), [("tof", 0.0), ("tof", 1.0), ("stereo", 1.0)])
def test_noise_that_grows_on_faces_seen_obliquely_is_no_shared_error(kind: str, grows: float) -> None:
    slanted = np.where(plate_rows(1).place[:, 0] > 0.13, 0.3, 0.95)  # a side face, and one that looks at the camera
    frames = [replace(plate_rows(1, seed), std=STD * slanted, cosine=slanted) for seed in range(3)]
    frames = [replace(rows, residual=rows.residual * slanted ** (1.0 - grows)) for rows in frames]
    before = replace(knowledge(), noises=(CameraNoise(kind, floor=STD),))
    learned = learn(before, [(rows, SAG) for rows in frames])
    if kind == "stereo":
        assert learned.slant == 0.0  # its noise does not grow so: that is an error of the model
        return
    assert learned.slant == grows
    np.testing.assert_allclose(weighed(learned, frames[0]).std, STD * slanted ** (1.0 - grows), rtol=0.03)
    assert learned.bias_m < 2e-5
    assert misfit(learned, weighed(learned, frames[0]), SAG) == pytest.approx(1.0, abs=0.1)


def test_flying_pixels_do_not_say_that_a_frame_is_not_explained():
    rows = plate_rows(1)
    learned = learn(knowledge(), [(rows, SAG), (plate_rows(1, 1), SAG)])
    flying = np.where(np.arange(len(rows.residual)) % 200 == 0, 70.0 * STD, rows.residual)
    assert misfit(learned, replace(rows, residual=flying), SAG) < learned.misfit_limit
    assert misfit(learned, replace(rows, residual=3.0 * rows.residual), SAG) > learned.misfit_limit


def test_the_scatter_of_points_is_that_of_their_means() -> None:
    """Noise alone, with and without outliers: groups of ten know the standard deviation of a point as well as the points do."""
    noise = np.random.default_rng(0).normal(size=(2000, 10))
    mean, ones = noise.mean(axis=1), np.ones(2000)
    points = replace(plate_rows(1), residual=noise.ravel(), std=np.ones(noise.size))
    means = replace(points, residual=mean, std=ones, number=10.0 * ones, scatter=noise.var(axis=1))
    assert points.spread(points.residual) == pytest.approx(1.0, abs=0.03)
    assert means.spread(means.residual) == pytest.approx(1.0, abs=0.03)
    far = np.where(np.arange(2000) % 50 == 0, 30.0, mean)
    assert means.spread(far) == pytest.approx(1.0, abs=0.05)


def test_shared_errors_are_no_larger_than_what_free_frames_leave():
    """Waves too short for the field of shared errors, far above the noise: it must not grow beyond them to bend after them, or a touch is no news."""

    def wavy(phase: float) -> Rows:
        rows = plate_rows(1)
        waves = 2e-4 * np.sin(rows.place[:, 0] / 0.012 + phase) * np.sin(rows.place[:, 1] / 0.012 + phase)
        return replace(rows, residual=waves + rows.residual / 30.0, std=rows.std / 30.0)

    learned = learn(knowledge(), [(wavy(phase), SAG) for phase in (0.0, 0.7, 1.9)])
    assert learned.bias_m < 5e-5
    assert learned.rough == pytest.approx(10.0, rel=0.2)  # the waves are 1e-4 m, the noise 1e-5 m


def smooth(amplitude: float, middle: float = 0.1) -> FloatArray:
    """Return a bump 40 mm wide on the plate [m], of the height `amplitude` at x = `middle`."""
    place = plate_rows(1).place
    return np.asarray(amplitude * np.exp(-(((place[:, 0] - middle) / 0.04) ** 2) - ((place[:, 1] - 0.05) / 0.04) ** 2))


def test_a_dent_that_the_shared_error_takes_up_is_too_large_for_it():
    """Free frames err by smooth tenths of a millimetre, each elsewhere. A dent of 2 mm as smooth leaves no misfit, and is no shared error."""

    def seen(height: float, middle: float, seed: int) -> Rows:
        rows = plate_rows(1, seed)
        return replace(rows, residual=0.1 * rows.residual + smooth(height, middle), std=0.1 * rows.std)

    learned = learn(knowledge(), [(seen(2e-4, 0.03 + 0.02 * i, i), SAG) for i in range(6)])
    dent, calm = (
        replace(seen(h, 0.09, 9), std=learned.rough * 0.1 * plate_rows(1).std, together=learned.together) for h in (2e-3, 2e-4)
    )
    assert misfit(learned, dent, SAG) < 2.0 * misfit(learned, calm, SAG)
    assert nuisance_excess(learned, calm, SAG) < learned.nuisance_limit < nuisance_excess(learned, dent, SAG)


def test_what_free_frames_leave_alike_is_expected_of_the_next_one():
    """A smooth error of 0.5 mm that is the same in each frame, where the calibration's pose cannot take it up."""
    bump = smooth(5e-4)
    frames = []
    for seed in range(5):
        rows = plate_rows(1, seed)
        frames.append((replace(rows, residual=rows.residual + bump), SAG))
    learned = learn(knowledge(), frames)
    columns, known = nuisance_columns(learned, frames[0][0], SAG)
    middle = bump > 2e-4
    np.testing.assert_allclose(known[middle], bump[middle], atol=5e-5)
    assert np.linalg.norm(columns[middle], axis=1).max() < 1e-4


def test_faces_that_look_elsewhere_err_on_their_own():
    """Of two rows at one edge, one on the upper face and one on the side; and of two on the upper face."""
    known, rows = knowledge(), plate_rows(1)
    known = replace(known, centres=np.repeat(known.centres[:12], 2, axis=0), facing=np.tile([UP, ASIDE], (12, 1)))
    pick = np.array([5000, 5000, 5001])
    edge = replace(rows, place=rows.place[pick], by_pose=np.zeros((3, 6)), functional=lambda u: np.zeros((3, len(u))))
    columns, _ = nuisance_columns(known, replace(edge, way=np.ones(3), facing=np.array([UP, ASIDE, UP])), SAG)
    together = columns @ columns.T
    assert together[0, 1] < 0.1 * together[0, 0]
    assert together[0, 2] > 0.9 * together[0, 0]


def test_free_frames_tell_how_hard_a_cable_truly_pulls():
    moves = np.zeros((2, 4, 3))
    before = first_knowledge(knowledge().noises, knowledge().centres, knowledge().facing, 0.22, 0.03, 1e-8 * np.eye(6), drives=1)
    frames = []
    for seed in range(3):
        rows = plate_rows(1, seed)
        by_pull = 2e-3 * rows.place[:, 0] / 0.2
        columns = np.column_stack([np.zeros_like(by_pull), by_pull])
        frames.append((replace(rows, functional=lambda u, c=columns: c, residual=rows.residual - 0.04 * by_pull), moves))
    learned = learn(before, frames)
    assert learned.mean[7] == pytest.approx(-0.04, abs=0.004)
    assert np.linalg.norm(learned.root[7]) < 0.01


def test_pulls_that_the_model_needs_say_how_far_its_answer_to_a_force_is_off():
    before = first_knowledge(knowledge().noises, knowledge().centres, knowledge().facing, 0.22, 0.03, 1e-8 * np.eye(6), drives=2)
    mean, root = before.mean.copy(), before.root.copy()
    mean[7:9], root[6:9, 6:9] = (0.04, -0.04), np.diag([0.0, 0.03, 0.03])
    assert response_std(replace(before, mean=mean, root=root), 1) == pytest.approx(0.05)
    stiffer = before.mean.copy()
    stiffer[6] = -0.065  # of the modulus, where no pulls are asked for
    assert response_std(replace(before, mean=stiffer, root=0.0 * root), 1) == pytest.approx(0.065)


def test_what_free_frames_do_not_show_stays_as_it_was_expected():
    expected = np.zeros(len(knowledge().mean))
    expected[6] = -0.02
    learned = learn(replace(knowledge(), mean=expected), [(plate_rows(1), SAG)])
    np.testing.assert_allclose(learned.mean[:7], expected[:7], atol=1e-12)


def pulled_and_let_go(folder: Path) -> Recording:
    """Return free frames of an arm whose cable rubs, the only cloud on the way back; then a frame with markers alone."""
    inputs = np.array([[0.0, 0, 0, 0], [1.5, 0, 0, 0], [3.0, 0, 0, 0], [1.2, 0, 0, 0], [1.2, 0, 0, 0]])
    recording, states = record(inputs, noise=1e-4, effects=FRICTION)
    true, rng = arm((8, 3, 3), law="neo_hookean"), np.random.default_rng(5)
    triangles = surface_triangles(true.body.mesh)
    x = states[3]
    corners = x[triangles]
    looks = np.einsum("tc,tc->t", triangle_normals(x, triangles), T_ROBOT_CAMERA[:3, 3] - corners.mean(axis=1)) > 0
    points = np.einsum("tsi,tic->tsc", rng.dirichlet(np.ones(3), size=(int(looks.sum()), 12)), corners[looks]).reshape(-1, 3)
    ray = points - T_ROBOT_CAMERA[:3, 3]
    points = points + 3e-4 * rng.normal(size=(len(points), 1)) * ray / np.linalg.norm(ray, axis=1, keepdims=True)
    write_cloud(
        folder / "3.ply",
        PointCloud(transform_points(invert_pose(T_ROBOT_CAMERA), points), np.tile([0.2, 0.4, 0.8], (len(points), 1))),
    )
    files = tuple((folder / "3.ply" if k == 3 else None,) for k in range(5))
    return replace(recording, free=np.array([True] * 4 + [False]), cloud_files=files, color_files=((None,),) * 5)


def test_free_frames_remember_friction(tmp_path):
    recording, robot = pulled_and_let_go(tmp_path), apply_effects(arm(), FRICTION)
    calibration = calibrate(robot, recording)
    assert calibration.normal_rms_m == pytest.approx(2e-4, abs=1e-4)
    known = make_sensor(robot, recording, calibration).knowledge
    assert abs(known.mean[6]) < 0.05 and known.bias_m < 3e-4


def test_a_declared_pose_is_not_taken_for_exact_where_clouds_tell_it(tmp_path):
    recording, robot = pulled_and_let_go(tmp_path), apply_effects(arm(), FRICTION)
    fitted = calibrate(robot, recording)
    off = moved_poses(fitted.poses, np.array([0.0, 4e-3, 0.0, 0.0, 0.0, 5e-4]), np.zeros(3))
    nobody = np.zeros_like(fitted.pose_covariance)
    declared = replace(fitted, poses=off, T_robot_camera=off[0], pose_covariance=nobody, joint_covariance=nobody)
    prepared = prepare(robot, recording, declared)
    sensor = prepared.sensor
    np.testing.assert_allclose(np.linalg.norm(prepared.first.root[:6], axis=1), POSE_STD)
    moved = np.linalg.norm((sensor.calibration.poses[0] - off[0])[:3, :3])
    assert moved > 0.2 * np.linalg.norm((fitted.poses[0] - off[0])[:3, :3])
    assert sensor.knowledge.bias_m < 3e-4


def test_what_clouds_leave_does_not_judge_frames_with_markers_alone(tmp_path):
    """The markers of the last frame shake twice as much as in the others."""
    recording, robot = pulled_and_let_go(tmp_path), apply_effects(arm(), FRICTION)
    shaken = recording.marker_xyz + 1.7e-4 * np.random.default_rng(3).normal(size=recording.marker_xyz.shape) * (
        recording.marker_frame == 4
    ).reshape(-1, 1)
    run = estimate(robot, replace(recording, marker_xyz=shaken), calibrate(robot, recording))
    assert [frame.status for frame in run.frames] == ["ok"] * 5
