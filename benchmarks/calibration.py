"""Calibration from anything, against its truth: markers with and without names, clouds alone, one and two cameras,
wrong labels, a real tentacle.

    python benchmarks/calibration.py [PART …] [--seeds N] [--first SEED]

Parts: bound, nowhere, clouds, labels, single, tentacle, rate, table1; all where none is named.
Recordings come from a finer mesh with another law than the one that calibrates. Prints every figure of docs/results/calibration.md.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "support")]

from arm import NAMES, T_ROBOT_CAMERA, arm, record  # noqa: E402
from tentacle import FOLDER, Run, recording_of, runs, tentacle  # noqa: E402

from femsense import DataError, Drives, Recording, Robot, Timeline, calibrate  # noqa: E402
from femsense.calib.cloud_pose_search import View, difference, find_cloud_pose  # noqa: E402
from femsense.calib.inputs import first_inputs  # noqa: E402
from femsense.calib.marker_assignment import name_markers  # noqa: E402
from femsense.core.arrays import FloatArray, IntArray  # noqa: E402
from femsense.core.pose import invert_pose, make_pose, rotation_from_vector, transform_points  # noqa: E402
from femsense.fem.mesh import surface_triangles  # noqa: E402
from femsense.model.contact_patch import body_surface  # noqa: E402
from femsense.model.drive import DrivenRobot, drive_of  # noqa: E402
from femsense.model.frame_state import solve_frame  # noqa: E402
from femsense.model.observation import Hypothesis, evaluate_scene, make_scene  # noqa: E402
from femsense.model.recording import make_recording, with_marker_table  # noqa: E402
from femsense.pointcloud.rays import Surface  # noqa: E402
from femsense.pointcloud.segmentation import color_mask  # noqa: E402
from femsense.rig.camera import Shape, camera_of, cloud_of, look, look_at, render  # noqa: E402
from femsense.rig.scene import floor_shape  # noqa: E402
from femsense.rig.script import NoiseTable, ViewTable  # noqa: E402

KEPT = np.array([0, 2, 4, 5, 7, 8, 10, 11])
"""Markers of the arm that break its symmetry."""
INPUTS = np.array([[0.0, 0, 0, 0], [0.5, 0, 0, 0], [0.5, 0, 0.4, 0], [0, 0, 0.6, 0], [0, 0.5, 0, 0], [0, 0, 0, 0.5]])
INITIAL = np.array([0.5, 0.4, 0.3, 0.4])
BLUE, GREY = np.array([0.2, 0.4, 0.8]), np.array([0.5, 0.5, 0.5])


# Errors over the bound


def turned(recording: Recording, rng: np.random.Generator) -> tuple[Recording, FloatArray]:
    """Return the recording in another camera frame, and its true pose."""
    T = make_pose(rotation_from_vector(rng.normal(size=3)), rng.normal(size=3))
    moved = with_marker_table(
        recording,
        recording.marker_names,
        recording.marker_frame,
        recording.marker_index,
        transform_points(T, recording.marker_xyz),
    )
    return moved, T_ROBOT_CAMERA @ invert_pose(T)


def paired(first: Recording, second: Recording) -> Recording:
    """Return both as two cameras of one recording."""
    return replace(
        first,
        camera_names=("a", "b"),
        cameras=(None, None),
        T_robot_camera=(None, None),
        cloud_files=((None, None),) * first.frame_count,
        color_files=((None, None),) * first.frame_count,
        marker_frame=np.concatenate([first.marker_frame, second.marker_frame]),
        marker_index=np.concatenate([first.marker_index, second.marker_index]),
        marker_view=np.repeat([0, 1], [len(first.marker_frame), len(second.marker_frame)]),
        marker_xyz=np.vstack([first.marker_xyz, second.marker_xyz]),
    )


def step_between(T: FloatArray, true: FloatArray, pivot: FloatArray) -> FloatArray:
    """Return (rotation about the pivot [rad], shift [m]) that takes the true pose to T, shape (6,)."""
    from scipy.spatial.transform import Rotation

    D = T @ invert_pose(true)
    return np.concatenate([Rotation.from_matrix(D[:3, :3]).as_rotvec(), D[:3, :3] @ pivot + D[:3, 3] - pivot])


def bound(seeds: int) -> None:
    print("\n## Errors over the bound\n")
    print("| inputs | cameras | pose, rms [mm] | pose / stated | input, rms | input / stated |\n|---|---|---|---|---|---|")
    for zero, actuation in (("absolute", "tension"), ("unknown", "tension"), ("unknown", "displacement")):
        for cameras in (1, 2):
            rows = [_one_bound(zero, actuation, cameras, seed) for seed in range(seeds)]
            shift, pose, off, own = (np.sqrt(np.mean([row[i] ** 2 for row in rows])) for i in range(4))
            unit, scale = ("N", 1.0) if actuation == "tension" else ("mm", 1e3)
            told = f"{scale * off:.3f} {unit} | {own:.2f}" if zero == "unknown" else "known | –"
            print(f"| {actuation}, {zero} | {cameras} | {1e3 * shift:.3f} | {pose:.2f} | {told} |", flush=True)


def _one_bound(zero: str, actuation: str, cameras: int, seed: int) -> tuple[float, float, float, float]:
    inputs, initial = (INPUTS, INITIAL) if actuation == "tension" else (4e-3 * INPUTS, 2e-3 * INITIAL)
    rng = np.random.default_rng(seed)
    how = {"zero": zero, "actuation": actuation, "initial": initial if zero == "unknown" else None, "noise": 2e-4}
    seen, true = turned(record(inputs, seed=seed, **how)[0], rng)
    if cameras == 2:
        seen = paired(seen, turned(record(inputs, seed=1000 + seed, **how)[0], rng)[0])
    robot = arm()
    found = calibrate(robot, seen)
    step = step_between(found.poses[0], true, robot.marker_points.mean(axis=0))
    pose = float(np.sqrt(step @ np.linalg.solve(found.pose_covariance, step) / 6.0))
    table, std = (
        (found.cable_tension_n, found.tension_std_n)
        if actuation == "tension"
        else (found.cable_displacement_m, found.displacement_std_m)
    )
    if zero == "absolute":
        return float(np.linalg.norm(step[3:])), pose, 0.0, 0.0
    off = np.array([table[name] - initial[i] for i, name in enumerate(NAMES)])
    own = off / [std[name] or np.inf for name in NAMES]
    return float(np.linalg.norm(step[3:])), pose, float(np.sqrt((off**2).mean())), float(np.sqrt((own**2).mean()))


# Markers without names


def lopsided() -> Robot:
    robot = arm()
    return replace(robot, marker_names=tuple(robot.marker_names[i] for i in KEPT)).with_marker_points(robot.marker_points[KEPT])


def nameless(recording: Recording, rng: np.random.Generator, *, outliers: int, missing: int) -> tuple[Recording, IntArray]:
    """Return the recording without names, shuffled, in another camera frame, and which marker (−1: outlier) each row is."""
    T = make_pose(rotation_from_vector(2.0 * rng.normal(size=3)), rng.normal(size=3))
    frame, xyz, truth = [], [], []
    for k in range(recording.frame_count):
        of = np.flatnonzero((recording.marker_frame == k) & np.isin(recording.marker_index, KEPT))
        of = rng.permutation(of)[missing:]
        points = recording.marker_xyz[of]
        wild = points.mean(axis=0) + rng.uniform(-0.08, 0.08, size=(outliers, 3))
        order = rng.permutation(len(of) + outliers)
        xyz.append(transform_points(T, np.vstack([points, wild])[order]))
        truth.append(np.concatenate([np.searchsorted(KEPT, recording.marker_index[of]), np.full(outliers, -1)])[order])
        frame.append(np.full(len(order), k))
    none = np.zeros(0, dtype=np.int64)
    bare = replace(recording, marker_frame=none, marker_index=none, marker_view=none, marker_xyz=np.zeros((0, 3)))
    count = sum(len(f) for f in frame)
    told = {"unnamed_frame": np.concatenate(frame), "unnamed_view": np.zeros(count, np.int64), "unnamed_xyz": np.vstack(xyz)}
    return replace(bare, **told), np.concatenate(truth)


def given_names(robot: Robot, bare: Recording, named: Recording) -> IntArray:
    at = {
        tuple(x): robot.marker_names.index(named.marker_names[i]) for x, i in zip(named.marker_xyz.tolist(), named.marker_index)
    }
    return np.array([at.get(tuple(x), -1) for x in bare.unnamed_xyz.tolist()])


def nowhere(seeds: int) -> None:
    print("\n## Markers without names, from nowhere: 8 markers, 6 frames\n")
    print(
        "| outliers, missing a frame | runs | right | refused | rows named right | wrong | left out | outliers taken "
        "|\n|---|---|---|---|---|---|---|---|"
    )
    robot = lopsided()
    for outliers, missing in ((0, 0), (1, 1), (2, 2), (3, 3)):
        rows = Counter()
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            bare, truth = nameless(record(INPUTS, noise=2e-4, seed=seed)[0], rng, outliers=outliers, missing=missing)
            try:
                given = given_names(robot, bare, name_markers(robot, bare, np.arange(len(INPUTS))))
            except DataError:
                rows["refused"] += 1
                continue
            wrong = ((given >= 0) & (given != truth) & (truth >= 0)).sum()
            rows += Counter(right=int(wrong == 0), wrong=wrong, named=((given == truth) & (truth >= 0)).sum())
            rows += Counter(out=((given < 0) & (truth >= 0)).sum(), taken=((given >= 0) & (truth < 0)).sum())
        print(
            (
                f"| {outliers}, {missing} | {seeds} | {rows['right']} | {rows['refused']} | {rows['named']} | "
                f"{rows['wrong']} | {rows['out']} | {rows['taken']} |"
            ),
            flush=True,
        )


# Clouds alone


def block(size: tuple[float, ...], middle: tuple[float, ...], color: tuple[float, ...]) -> Shape:
    import trimesh

    box = trimesh.creation.box(extents=size)
    return Shape(np.array(box.vertices) + middle, np.array(box.faces), np.array(color))


HIDDEN = 1 / 3
"""Scenes in which more of what the camera would see of the body is hidden are counted by themselves."""


def clouds(seeds: int, first: int = 0) -> None:
    print("\n## Clouds alone, from nowhere: two free frames, a table, a box and the holder in sight\n")
    print(
        "| colour tells the robot | scenes | right | refused | of these, a third and more is hidden | wrong | "
        "turn, median, largest [°] | shift, median, largest [mm] |\n|---|---|---|---|---|---|---|---|"
    )
    inputs = np.array([[2.0, 0, 0, 0], [0, 0, 2.0, 0]])
    recording, states = record(inputs)
    robot, true = arm(), arm((8, 3, 3), law="neo_hookean")
    driven = DrivenRobot(robot, drive_of(robot, recording))
    model = [Surface(solve_frame(driven, k).positions, body_surface(robot.body.mesh).triangles) for k in range(2)]
    for colored in (True, False):
        kinds, turns, shifts = Counter(), [], []
        for seed in range(first, first + seeds):
            T, views, hidden = _scene(true, states, model, seed, colored=colored)
            try:
                found = find_cloud_pose(views).T_robot_camera
            except DataError as error:
                print(f"  seed {seed}, {hidden:.0%} hidden: {str(error)[:60]}", flush=True)
                kinds += Counter(refused=1, hidden=int(hidden > HIDDEN))
                continue
            turn, shift = difference(found, T, model[0])
            kinds["right" if turn < 0.2 and shift < 0.01 else "wrong"] += 1
            turns, shifts = [*turns, np.degrees(turn)], [*shifts, 1e3 * shift]
        texts = [f"{np.median(v):.1f}, {np.max(v):.1f}" if v else "–" for v in (turns, shifts)]
        print(
            (
                f"| {'yes' if colored else 'no'} | {seeds} | {kinds['right']} | {kinds['refused']} | {kinds['hidden']} | "
                f"{kinds['wrong']} | {' | '.join(texts)} |"
            ),
            flush=True,
        )


def _scene(
    true: Robot, states: list[FloatArray], model: list[Surface], seed: int, *, colored: bool
) -> tuple[FloatArray, list[View], float]:
    """Return the true pose of a camera, what it sees in each frame, and which share of the body other things hide from it."""
    rng = np.random.default_rng(seed)
    side = rng.normal(size=3)
    side[2] = abs(side[2]) + 0.2
    eye = np.array([0.05, 0, 0]) + side / np.linalg.norm(side) * rng.uniform(0.25, 0.45)
    T = look_at(eye, np.array([0.05, 0, 0]) + 0.01 * rng.normal(size=3), roll=rng.uniform(0, 6.28))
    camera = camera_of(ViewTable(eye_m=[0, 0, 1], target_m=[0, 0, 0]))
    things = [floor_shape(-0.06, np.array([0.7, 0.6, 0.5])), block((0.08, 0.06, 0.05), (0.12, 0.1, -0.035), (0.8, 0.2, 0.2))]
    things.append(block((0.04, 0.06, 0.06), (-0.021, 0.0, 0.0), (0.5, 0.5, 0.5)))
    views, bare = [], []
    for state, surface in zip(states, model):
        body = Shape(state, surface_triangles(true.body.mesh), BLUE)
        cloud = cloud_of(render(camera, T, [body, *things], noise=NoiseTable(), rng=rng), camera)
        mine = color_mask(cloud.colors, BLUE) if colored else np.ones(len(cloud.points), dtype=bool)
        views.append(View(cloud.points, mine, surface, colored))
        pixels = [int((look(camera, T, shapes).shape == 0).sum()) for shapes in ([body, *things], [body])]
        bare.append(pixels[0] / max(pixels[1], 1))
    return T, views, 1.0 - float(np.mean(bare))


# Labels


def labels(seeds: int) -> None:
    print("\n## Wrong labels and outliers among named markers: 12 markers, 6 frames\n")
    print("| what is wrong | runs | said | clean runs accused | pose, median [mm] |\n|---|---|---|---|---|")
    for kind in (
        "nothing",
        "two labels swapped in one frame",
        "an outlier in one frame",
        "two labels swapped in all frames",
        "mirrored",
        "inches",
    ):
        said, off = 0, []
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            recording, _ = record(INPUTS, noise=2e-4, seed=seed)
            with warnings.catch_warnings(record=True) as heard:
                warnings.simplefilter("always")
                try:
                    found = calibrate(arm(), _spoiled(recording, kind, rng))
                    off.append(
                        1e3 * float(np.linalg.norm(step_between(found.poses[0], T_ROBOT_CAMERA, np.array([0.05, 0, 0]))[3:]))
                    )
                    said += any("left out" in str(w.message) or "corrected" in str(w.message) for w in heard)
                except DataError:
                    said += 1
        told = ("–", said) if kind == "nothing" else (said, "–")
        print(f"| {kind} | {seeds} | {told[0]} | {told[1]} | {f'{np.median(off):.2f}' if off else 'refused'} |", flush=True)


def _spoiled(recording: Recording, kind: str, rng: np.random.Generator) -> Recording:
    xyz, index = recording.marker_xyz.copy(), recording.marker_index.copy()
    frame = recording.marker_frame == rng.integers(recording.frame_count)
    a, b = rng.choice(12, 2, replace=False)
    where = frame if "one frame" in kind else np.ones(len(frame), dtype=bool)
    if "swapped" in kind:
        index[where & (recording.marker_index == a)], index[where & (recording.marker_index == b)] = b, a
    elif "outlier" in kind:
        xyz[frame & (index == a)] += rng.uniform(0.015, 0.04) * rng.choice([-1, 1], 3)
    elif kind == "mirrored":
        xyz[:, rng.integers(3)] *= -1.0
    elif kind == "inches":
        xyz *= 39.37
    return with_marker_table(recording, recording.marker_names, recording.marker_frame, index, xyz)


# One cable's input


LEVELS = np.array([(0, 0, 0, 0), (0.8, 0, 0, 0), (0.4, 0, 0, 0), (0, 0.7, 0, 0), (0, 0, 0.9, 0), (0, 0, 0, 0.5), (0, 0, 0.3, 0)])


def single(seeds: int) -> None:
    print("\n## The input of one cable is off: 12 markers, 7 frames\n")
    print("| what is wrong | runs | said | offset, median [N] | gain, median | left [mm] |\n|---|---|---|---|---|---|")
    for kind, gain, offset, modulus in (
        ("nothing", 1.0, 0.0, 300e3),
        ("the modulus of the robot, by half", 1.0, 0.0, 450e3),
        ("an offset of a quarter of the range", 1.0, 0.2, 300e3),
        ("an offset of half the range", 1.0, 0.4, 300e3),
        ("a gain of 0.8", 1.25, 0.0, 300e3),
    ):
        rows = [_one_single(arm(modulus=modulus), seed, gain, offset) for seed in range(seeds)]
        said = [found for found, _ in rows if found]
        add, times = (f"{np.median([one[i] for one in said]):.3f}" if said else "–" for i in (1, 0))
        print(
            f"| {kind} | {seeds} | {len(said)} | {add} | {times} | {1e3 * np.median([left for _, left in rows]):.2f} |",
            flush=True,
        )


def _one_single(robot: Robot, seed: int, gain: float, offset: float) -> tuple[tuple[float, float] | None, float]:
    """Return gain and offset [N] that calibrate reports for the first cable, None where it reports none, and the residual [m]."""
    recording = record(LEVELS, noise=2e-4, seed=seed)[0]
    inputs = recording.inputs * [gain, 1.0, 1.0, 1.0] + np.array([offset, 0.0, 0.0, 0.0])
    spoiled = replace(recording, inputs=inputs)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        found = calibrate(robot, spoiled)
    read = re.search(
        rf"input of {NAMES[0]} alone seems off \(times (\S+) ± \S+, plus (\S+) ±", " ".join(str(w.message) for w in heard)
    )
    return (float(read[1]), float(read[2])) if read else None, found.rms_m


# The real tentacle


def sessions(every: list[Run]) -> Iterator[tuple[str, list[Run]]]:
    a = {f"{m}_{u}" for m in ("m1", "m2") for u in ("u01", "u015", "u02", "u025")}
    yield "session A, 8 runs in one recording", [run for run in every if run.name in a]
    yield "session B, 10 runs in one recording", [run for run in every if run.name not in a]


def real_tentacle(_: int) -> None:
    print("\n## data/tentacle: raw files, names permuted from frame to frame, the authors' prior as robot\n")
    if not FOLDER.is_dir():
        print("not there")
        return
    robot, every = tentacle(cells=(12, 2, 2)), runs(every=300)
    print(
        "| recording | rows | right | wrong | left out | refused | rms of named markers [mm], share of their spread | "
        "accused |\n|---|---|---|---|---|---|---|---|"
    )
    total = Counter()
    alone = [(run.name, [run]) for run in every]
    for name, chosen in [*alone, *sessions(every)]:
        recording, truth = recording_of(chosen, frames=3 if len(chosen) == 1 else 1, rng=np.random.default_rng(1))
        rms, share, accused = _named_rms(robot, recording, truth)
        row = Counter(rows=len(truth), accused=accused)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                given = given_names(robot, recording, name_markers(robot, recording, np.arange(recording.frame_count)))
            row += Counter(right=(given == truth).sum(), wrong=((given >= 0) & (given != truth)).sum(), out=(given < 0).sum())
        except DataError:
            row["refused"] += 1
        total += row
        cells = (row["rows"], row["right"], row["wrong"], row["out"], row["refused"], f"{rms:.1f}, {share:.2f}", row["accused"])
        print(f"| {name} | {' | '.join(map(str, cells))} |", flush=True)
    print(
        f"| all | {total['rows']} | {total['right']} | {total['wrong']} | {total['out']} | {total['refused']} | | "
        f"{total['accused']} |"
    )


def _named_rms(robot: Robot, recording: Recording, truth: IntArray) -> tuple[float, float, int]:
    named = with_marker_table(recording, robot.marker_names, recording.unnamed_frame, truth, recording.unnamed_xyz)
    none = np.zeros(0, dtype=np.int64)
    named = replace(named, unnamed_frame=none, unnamed_view=none, unnamed_xyz=np.zeros((0, 3)))
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        try:
            found = calibrate(robot, named)
        except DataError as error:
            print(f"  accused: {error}"[:160])
            return np.nan, np.nan, 1
    accused = sum("left out" in str(w.message) or "corrected" in str(w.message) for w in heard)
    spread = np.sqrt(((robot.marker_points - robot.marker_points.mean(axis=0)) ** 2).sum(axis=1).mean())
    return 1e3 * found.rms_m, found.rms_m / float(spread), accused


# Rate


def rate(_: int) -> None:
    print("\n## A calibration step: nine markers, pose and initial inputs together\n")
    print("| body | nodes | markers | step [ms of processor time] | rate [Hz] |\n|---|---|---|---|---|")
    for name, robot in _bodies():
        recording, _ = _seen(robot)
        scene = make_scene(robot, recording, np.array([0]))
        pivot, initial = robot.marker_points.mean(axis=0), first_inputs(robot, recording)
        starts: dict = {}
        how = {"derivative": True, "vary_initial": True, "pivot": pivot, "starts": starts}
        evaluate_scene(Hypothesis(robot), scene, np.zeros(0), [T_ROBOT_CAMERA], initial, **how)
        began, steps = time.process_time(), 20
        for i in range(steps):
            moved = None if initial is None else initial + 1e-3 * (i % 2)
            jet = evaluate_scene(Hypothesis(robot), scene, np.zeros(0), [T_ROBOT_CAMERA], moved, **how)
            J = np.concatenate([jet.by_pose, jet.by_initial], axis=2).reshape(jet.residual.size, -1)
            np.linalg.lstsq(J, jet.residual.ravel(), rcond=None)
        spent = (time.process_time() - began) / steps
        print(
            f"| {name} | {len(robot.body.mesh.nodes)} | {len(robot.marker_names)} | {1e3 * spent:.1f} | {1 / spent:.0f} |",
            flush=True,
        )


def _bodies() -> Iterator[tuple[str, Robot]]:
    from femsense.io.robot_toml import load_robot

    for name in ("diamond", "finger"):
        folder = ROOT.parent / "shared" / "data" / name
        if folder.is_dir():
            yield f"data/{name}", _nine(load_robot(folder))
    yield "arm of the tests", _nine(arm())


def _nine(robot: Robot) -> Robot:
    places = robot.body.mesh.nodes[robot.features[:9]]
    return replace(robot, marker_names=tuple(f"m{i}" for i in range(len(places))), marker_share=None).with_marker_points(places)


def _seen(robot: Robot) -> tuple[Recording, FloatArray]:
    count, a = len(robot.marker_names), len(robot.body.cables)
    plain = make_recording(Timeline([0.0]), drives=Drives(robot.body.cable_names, np.full((1, a), 0.1), actuation_zero="unknown"))
    model = robot.marker_points + 1e-4 * np.random.default_rng(0).normal(size=(count, 3))
    seen = transform_points(invert_pose(T_ROBOT_CAMERA), model)
    return with_marker_table(plain, robot.marker_names, np.zeros(count, np.int64), np.arange(count), seen), seen


# Table I of the paper


def table_one(seeds: int) -> None:
    """Print how exactly the pose and the tensions of Table I (Zhang et al. 2019) come back from exact markers of the diamond."""
    from femsense.io.robot_toml import load_robot

    print("\n## Table I of the paper: the diamond under 1.2, 1, 1 and 1.2 N\n")
    print("| markers | place | turn | tensions | residual |\n|---|---|---|---|---|")
    U, _, Vt = np.linalg.svd([[-0.147, 0.941, 0.305], [-0.485, 0.200, -0.851], [-0.862, -0.273, 0.427]])
    T, tensions = make_pose(U @ Vt, [-0.264956, 0.263885, 0.012767]), np.array([1.2, 1.0, 1.0, 1.2])
    folder = ROOT.parent / "shared" / "data" / "diamond"
    for count in (5, 9) if folder.is_dir() else ():
        robot = _marked(load_robot(folder), count)
        names = robot.body.cable_names
        plain = make_recording(Timeline([0.0]), drives=Drives(names, np.zeros((1, 4)), actuation_zero="unknown"))
        state = solve_frame(DrivenRobot(robot, drive_of(robot, plain, initial=tensions)), 0)
        seen = transform_points(invert_pose(T), robot.markers.positions(state.positions))
        markers = with_marker_table(plain, robot.marker_names, np.zeros(count, np.int64), np.arange(count), seen)
        found = calibrate(robot, markers)
        apart = found.T_robot_camera @ invert_pose(T)
        off = np.abs(np.array(list(found.cable_tension_n.values())) - tensions).max()
        place = 1e3 * np.linalg.norm(found.T_robot_camera[:3, 3] - T[:3, 3])
        turn = np.degrees(np.linalg.norm(apart[:3, :3] - np.eye(3)) / np.sqrt(2.0))
        print(f"| {count} | {place:.0e} mm | {turn:.0e}° | {off:.0e} N | {1e3 * found.rms_m:.0e} mm |", flush=True)


def _marked(diamond: Robot, count: int) -> Robot:
    """Return the diamond with markers at the top, around its middle, and nearer to the top, as many as asked for."""
    angle = np.arange(4) * np.pi / 2
    outer = np.stack([0.09 * np.cos(angle), 0.09 * np.sin(angle), np.full(4, 0.05)], axis=1)
    wanted = np.vstack([[0, 0, 0.125], outer, outer * [0.5, 0.5, 1.6]])[:count]
    nodes = np.linalg.norm(diamond.body.mesh.nodes[:, None] - wanted, axis=2).argmin(axis=0)
    names = tuple(f"m{i}" for i in range(count))
    return replace(diamond, marker_names=names, marker_share=None).with_marker_points(diamond.body.mesh.nodes[nodes])


PARTS = {
    "bound": bound,
    "nowhere": nowhere,
    "clouds": clouds,
    "labels": labels,
    "single": single,
    "tentacle": real_tentacle,
    "rate": rate,
    "table1": table_one,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", nargs="*", choices=[[], *PARTS], help="what to measure; all where nothing is named")
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--first", type=int, default=0, help="the first seed of `clouds`")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for part in options.part or list(PARTS):
            began = time.process_time()
            PARTS[part](options.seeds, *([options.first] if part == "clouds" else []))
            print(f"\n({part}: {time.process_time() - began:.0f} s of processor time)")


if __name__ == "__main__":
    main()
