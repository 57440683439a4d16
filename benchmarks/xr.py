"""From sensors to bones: how fast, and how far off, on real data and on the virtual rig.

    python benchmarks/xr.py [--only speed arm actuator skin] [--data ../shared/data/arm] [--states FILE.npz] [--keep DIR] [--pieces NAME …]

speed     the steps of the paper's table (Borges et al. 2022): network, spline and bones, end-to-end network, whole pose
arm       a two-segment pneumatic arm, real: held-out errors by sensors, other days, correction, inputs outside what was learnt
          With --keep each piece of it is kept as it is done: a run that was cut off goes on there, and --pieces does some of them.
actuator  a pneumatic finger with colour sensors and obstacles on the rig: surface error by how extreme the deformation is
skin      how far skinned surfaces are off the finite elements in states that they were not fitted to, by number of bones
"""

from __future__ import annotations

import argparse
import contextlib
import gzip
import io
import itertools
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import femsense as fs
from femsense import Armature, embed_points
from femsense.core.arrays import FloatArray
from femsense.fem.mesh import surface_triangles
from femsense.rig.sensors import SensorTable, sensor_readings
from femsense.xr.proprioception.domain import learn_domain
from femsense.xr.proprioception.drift import adapt, drift
from femsense.xr.proprioception.labelled import Labelled, joined
from femsense.xr.proprioception.learn import errors_on
from femsense.xr.proprioception.linear import train_ridge
from femsense.xr.proprioception.memory import with_memory
from femsense.xr.proprioception.model import bones_from_numbers
from femsense.xr.proprioception.selection import marker_rms
from femsense.xr.skinning import INFLUENCES, Skin, fit_poses, fit_skin, skin_vertices
from femsense.xr.stream.drag_server import drive_inputs
from femsense.xr.stream.payloads import Input

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "arm"
PRESSURES, ENCODERS = (4, 5, 6, 10, 11, 12), (13, 14, 15, 16)
SENSORS = {"draw wires": ENCODERS, "pressures": PRESSURES, "both": (*PRESSURES, *ENCODERS)}
README_MM = {"draw wires": 5.4, "pressures": 36.8, "both": 9.6}
FEW = 40
BACK = np.stack([np.zeros(6), np.zeros(6), -np.linspace(0.012, 0.0745, 6)], axis=1)
"""Markers on the flat side of the finger, its layer that stretches least [m]."""
PARTS = ("speed", "arm", "actuator", "skin")
ROBOTS, COUNTS = ("finger", "arm", "four-leg", "gripper", "pneu-finger"), (8, 12, 24, 32)
STATES = 240
BONES = 8


# ---- speed ----------------------------------------------------------------------------------------------------------


def speed() -> None:
    """Print the paper's table beside ours: 16 inputs, six markers, five bones."""
    rng = np.random.default_rng(0)
    bend = np.cumsum(0.2 * rng.normal(size=400))
    bend = 8.0 * np.sin(bend)
    s = np.linspace(0.02, 0.1, 6)
    angle = bend[:, None] * s + 1e-9
    markers = np.stack([s * (1 - np.cos(angle)) / angle, 0 * angle, s * np.sin(angle) / angle], axis=2)
    readings = np.tanh(bend[:, None] * rng.normal(size=16) / 10) + 0.01 * rng.normal(size=(400, 16))
    data = fs.labelled(np.arange(400) / 60, readings, markers)
    options = fs.LearnOptions(kinds=("network",), memories=((),), end_to_end=True, bones=fs.ArmatureOptions(bones=5))
    model = fs.learn(data, options=options)
    row, x = readings[0], readings[:1]
    live, direct = replace(model, bones=None).live(), model.live()
    steps = {
        "network forward pass": (lambda: model.network(x), "0.68 ± 0.09"),
        "spline and bones": (lambda: model.chain(markers[0]), "3.30 ± 1.05"),
        "end-to-end network": (lambda: bones_from_numbers(model.bones(x)[0]), "2.69 ± 0.10"),
        "whole pose, with the check": (lambda: live.step(row, 0.0), "3.98"),
        "the same, end to end": (lambda: direct.step(row, 0.0), "2.69 ± 0.10"),
    }
    print("step                          ours [ms, processor time]   paper [ms]")
    for name, (step, paper) in steps.items():
        took = np.array([timed(step) for _ in range(400)])
        print(f"{name:<28} {np.median(took):7.3f} ± {np.std(np.sort(took)[:380]):.3f}   {paper}")


def timed(step: object) -> float:
    begin = time.process_time()
    step()  # type: ignore[operator]
    return 1e3 * (time.process_time() - begin)


# ---- the arm --------------------------------------------------------------------------------------------------------


def read_arm(name: str, columns: tuple[int, ...], folder: Path) -> Labelled:
    """Return readings with middle and tip in the frame of the base, which stands still within a recording."""
    with gzip.open(folder / f"{name}.csv.gz", "rt") as file:
        table = np.loadtxt(file, delimiter=",")
    base = Rotation.from_quat(table[:, 20:24])
    tip = base.inv().apply(table[:, 31:34] - table[:, 17:20])
    up = base[tip[:, 2] < 0].mean().inv()  # the motion capture takes the base for its mirror image in half of the January frames
    places = np.stack([up.apply(table[:, k : k + 3] - table[:, 17:20]) for k in (24, 31)], axis=1)
    channels = [f"{'pressure' if c in PRESSURES else 'wire'}_{c}" for c in columns]
    return fs.labelled(
        table[:, 0] - table[0, 0], table[:, list(columns)], places, channels=channels, marker_names=("middle", "tip")
    )


def tip_only(data: Labelled) -> Labelled:
    return fs.labelled(data.time_s, data.readings, data.markers[:, 1:], channels=data.channels, marker_names=("tip",))


def arm(folder: Path, keep: Path | None, pieces: list[str]) -> None:
    """Print the tables of the real arm, piece after piece."""
    print("tip, first 70 % of apr_5 to its last 30 % [mm]")
    print("sensors      linear (README)  chosen   held out        last 30 % (95 %)       within the interval   outside")
    work: dict[str, Callable[[], None]] = {name: partial(sensors, name, folder) for name in SENSORS}
    work |= {"january": partial(january, folder), "days": partial(other_days, folder), "inside": partial(inside, folder)}
    for name, step in work.items():
        if not pieces or name in pieces:
            print(kept(name, step, keep), end="", flush=True)


def kept(name: str, step: Callable[[], None], keep: Path | None) -> str:
    """Return what a piece prints: read where it was done before, else done now and kept."""
    file = None if keep is None else keep / f"{name.replace(' ', '_')}.txt"
    if file is not None and file.is_file():
        return file.read_text(encoding="utf-8")
    said, begun = io.StringIO(), time.process_time()
    with contextlib.redirect_stdout(said):
        step()
        print(f"  ({time.process_time() - begun:.0f} s of processor time)")
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(said.getvalue(), encoding="utf-8")
    return said.getvalue()


def sensors(name: str, folder: Path) -> None:
    """Print the row of a choice of sensors."""
    data = tip_only(read_arm("apr_5_1", SENSORS[name], folder))
    cut = int(0.7 * len(data))
    report = fs.learn(data.select(np.arange(cut)), test=data.select(np.arange(cut, len(data)))).report
    test = report["test"]
    low, high = test["error_ci_mm"]
    print(
        f"{name:<12} {README_MM[name]:7.1f}          {report['kind']:<9} {report['error_mm']:6.2f}       {test['error_mm']:6.2f} ({low:.2f} … {high:.2f})"
        f"     {100 * test['coverage']:8.0f} %             {100 * test['outside']:.0f} %"
    )


def january(folder: Path) -> None:
    one, two, three = (tip_only(read_arm(f"Jan_10-2_{k}", SENSORS["both"], folder)) for k in (1, 2, 3))
    report = fs.learn(joined([one, two]), test=three).report
    test = report["test"]
    low, high = test["error_ci_mm"]
    print(
        f"Jan_10-2_1 + 2 to 3, both: {report['kind']} {test['error_mm']:.2f} mm ({low:.2f} … {high:.2f}), {100 * test['coverage']:.0f} % within the "
        "interval; linear (README) 1.4"
    )
    print("one or two sessions to the others, middle and tip, draw wires")
    days = [read_arm(f"Jan_10-2_{k}", ENCODERS, folder) for k in (1, 2, 3)]
    for learnt, others in (((0,), (1, 2)), ((0, 1), (2,)), ((1, 2), (0,))):
        model = fs.learn(joined([days[k] for k in learnt]))
        for k in others:
            found = errors_on(model, days[k], model.report["error_mm"])
            print(
                f"   {' + '.join(f'Jan_10-2_{i + 1}' for i in learnt)} to {k + 1}: {model.report['kind']} held out {model.report['error_mm']:.2f} mm, there "
                f"{found['error_mm']:.2f} mm, {100 * found['coverage']:.0f} % within the interval"
            )


def other_days(folder: Path) -> None:
    print(f"\nanother day: learnt on apr_5, middle and tip, draw wires; corrected by {FEW} labelled frames")
    model = fs.learn(read_arm("apr_5_1", ENCODERS, folder))
    print(f"on apr_5 itself, held-out blocks: {model.report['error_mm']:.2f} mm")
    for name in ("apr_4_1", "apr_4_2", "Jan_10-2_1"):
        day = read_arm(name, ENCODERS, folder)
        few = np.zeros(len(day), dtype=bool)
        few[np.linspace(0, len(day) - 1, FEW).astype(int)] = True
        mended = adapt(model, day.select(few))
        left = day.select(~few)
        found = errors_on(mended, left, model.report["error_mm"])
        line = train_ridge(day.select(few).readings, day.select(few).targets, penalty=1e-4)
        print(f"{name}: {drift(model, day).text}")
        print(
            f"   corrected by {mended.report['adapted']['by']}: {found['error_mm']:.2f} mm on the {len(left)} other frames, "
            f"{100 * found['coverage']:.0f} % within the interval; a linear map of them {1e3 * marker_rms(line(left.readings) - left.targets):.2f} mm"
        )


def inside(folder: Path) -> None:
    """Print the share of rows that the domain check lets pass: the same motion, and chambers that were not trained."""
    data = read_arm("apr_5_1", SENSORS["both"], folder)
    cut = int(0.7 * len(data))
    same, new = (np.arange(len(data)) >= cut) & (data.time_s < 60), data.time_s > 62
    domain = learn_domain(data.readings[:cut])
    trained = [read_arm(f"Jan_10-2_{k}", SENSORS["both"], folder).readings for k in (1, 2, 3)]
    winter = learn_domain(np.concatenate(trained[:2]))
    print("\nrows called inside what was learnt")
    print(
        f"apr_5 to 48 s:        the same motion {share(domain, data.readings[same])}, two chambers emptied at 60 s "
        f"{share(domain, data.readings[new])}"
    )
    print(
        f"Jan_10-2_1 + 2:       the same motion {share(winter, trained[2])}, six chambers (apr_5) {share(winter, data.readings)}"
    )


def share(domain: object, rows: FloatArray) -> str:
    passed = domain.inside(rows)  # type: ignore[attr-defined]
    return f"{100 * passed.mean():.2f} % of {len(rows)}"


# ---- the actuator on the rig ----------------------------------------------------------------------------------------


def actuator(file: Path | None) -> None:
    """Print the errors of the surface by how extreme the deformation is."""
    robot = fs.load_robot("pneu-finger")
    mesh = robot.body.mesh
    nodes = np.concatenate([mesh.nodes[None], finger_states(robot, file)])
    markers = np.array([embed_points(mesh, BACK).positions(x) for x in nodes])
    rng = np.random.default_rng(7)
    at = np.arange(len(nodes)) / 20.0
    readings = sensor_readings(colour_sensors(), mesh, nodes, at, rng=rng)
    noisy = markers + 1e-4 * rng.normal(size=markers.shape)
    channels = [channel for sensor in colour_sensors() for channel in sensor.channels]
    data = fs.labelled(at, readings, noisy, channels=channels)
    cut = int(0.8 * len(data))
    bones = fs.ArmatureOptions(bones=BONES, plane_normal=(0, 1, 0))
    test = np.arange(cut, len(data))
    options = fs.LearnOptions(kinds=("ridge", "radial", "network"), end_to_end=True, bones=bones)
    model = fs.learn(data.select(np.arange(cut)), test=data.select(test), options=options)
    print(
        f"{len(readings[0])} channels, six markers, {BONES} bones; {cut} states to learn, {len(test)} to test; map: "
        f"{model.report['kind']}"
    )
    for kind, row in model.report["compared"].items():
        print(f"  {kind:<8} markers {row['error_mm']:.3f} mm")
    surface = np.unique(mesh.boundary_faces) if hasattr(mesh, "boundary_faces") else np.arange(len(mesh.nodes))
    actuator_table(model, nodes[:, surface], mesh.nodes[surface], markers, readings, at, cut)


def actuator_table(
    model: fs.ProprioceptiveModel,
    states: FloatArray,
    rest: FloatArray,
    markers: FloatArray,
    readings: FloatArray,
    at: FloatArray,
    cut: int,
) -> None:
    chain = model.chain
    assert chain is not None and model.bones is not None
    inputs = with_memory(at, readings, model.memory_s)[cut:]
    found = model.network(inputs).reshape(-1, 6, 3)
    chained = chain_skin(rest, chain)
    finite = fit_skin(rest, states[:cut], bones=BONES)
    wanted = states[cut:]
    ways = {
        "skeleton fitted to the FE surface": skin_vertices(finite, fit_poses(finite, wanted)),
        "true markers, spline, bones": skin_vertices(chained, np.array([chain(x).T_robot_bone for x in markers[cut:]])),
        "network, spline, bones": skin_vertices(chained, np.array([chain(x).T_robot_bone for x in found])),
        "end-to-end network": skin_vertices(chained, np.array([bones_from_numbers(y).T_robot_bone for y in model.bones(inputs)])),
    }
    moved = np.linalg.norm(markers[cut:, -1] - BACK[-1], axis=1)
    edges = np.quantile(moved, [0, 1 / 3, 2 / 3, 1])
    groups = [(moved >= low) & (moved <= high) for low, high in itertools.pairwise(edges)]
    print(
        "tip moved by [mm]                  "
        + "".join(f"{1e3 * a:8.1f} …{1e3 * b:5.1f}" for a, b in itertools.pairwise(edges))
        + "       all"
    )
    error = np.linalg.norm(found - markers[cut:], axis=2)
    print(f"{'markers by the network':<36}" + "".join(f"{rms_mm(error[g]):15.3f}" for g in groups) + f"{rms_mm(error):10.3f}")
    for name, vertices in ways.items():
        error = np.linalg.norm(vertices - wanted, axis=2)
        print(f"{name:<36}" + "".join(f"{rms_mm(error[g]):15.3f}" for g in groups) + f"{rms_mm(error):10.3f}")


def rms_mm(distance: FloatArray) -> float:
    return 1e3 * float(np.sqrt((distance**2).mean()))


def finger_states(robot: fs.Robot, file: Path | None) -> FloatArray:
    """Return nodes of the finger under pressures that wander, pushed here and there [m], shape (F, n, 3)."""
    if file is not None and file.is_file():
        return np.asarray(np.load(file)["nodes"])
    rng = np.random.default_rng(3)
    smooth = np.exp(-0.5 * (np.arange(-12, 13) / 4) ** 2)
    wander = [np.convolve(rng.normal(size=STATES + 24), smooth, mode="valid") for _ in range(3)]
    pressure = 8e3 + 8e3 * wander[0] / np.abs(wander[0]).max()
    x = robot.body.mesh.nodes
    back = np.flatnonzero(np.abs(x[:, 0]) < 1e-6)
    states, last = [], None
    for p, push, height in zip(pressure, wander[1], wander[2]):
        force = np.zeros_like(x)
        place = -0.05 - 0.02 * np.tanh(height / 3)
        near = back[np.abs(x[back, 2] - place) < 0.006]
        force[near, 0] = 0.12 * max(push, 0.0) / np.abs(wander[1]).max() / len(near)
        last = fs.solve_equilibrium(robot.body, pressure={"air": float(p)}, nodal_forces=force, start=last)
        assert last.status == "converged", last.status
        states.append(last.positions)
    nodes = np.array(states)
    if file is not None:
        np.savez_compressed(file, nodes=nodes)
    return nodes


def colour_sensors() -> list[SensorTable]:
    """Return four colour sensors on the flat side, each looking at the pocket in front of it, as in the paper."""
    common = {"kind": "colour", "period_m": 0.012, "noise_std": 0.01, "across": [0.0, 0.0, 1.0]}
    return [
        SensorTable.model_validate({"name": f"eye{i}", "from_m": [0.0, 0.0, z], "to_m": [0.02, 0.0, z - 0.0065], **common})
        for i, z in enumerate((-0.012, -0.025, -0.038, -0.051))
    ]


def chain_skin(rest: FloatArray, chain: Armature) -> Skin:
    """Return a skin whose weights fall linearly from bone to bone along the chain, as the paper's ramps."""
    skeleton = chain.skeleton
    line = np.vstack([chain.rest_points[0], skeleton.origins, chain.rest_points[-1]])
    dense = np.linspace(0.0, 1.0, 400)[:, None]
    points = np.concatenate([a + dense * (b - a) for a, b in itertools.pairwise(line)])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    nearest = np.array([np.argmin(((points - vertex) ** 2).sum(axis=1)) for vertex in rest])
    place = np.interp(along[nearest], chain.at, np.arange(len(chain)))
    low = np.minimum(place.astype(int), len(chain) - 2)
    joints, weights = np.zeros((len(rest), INFLUENCES), np.int64), np.zeros((len(rest), INFLUENCES))
    joints[:, 0], joints[:, 1] = low, low + 1
    weights[:, 0], weights[:, 1] = 1.0 - (place - low), place - low
    joints[weights == 0.0] = 0
    return Skin(skeleton, rest, joints, weights)


# ---- skin -----------------------------------------------------------------------------------------------------------


def skin(diamond: Path) -> None:
    """Print held-out errors of skinned surfaces by number of bones: 40 random states to fit, 20 to test."""
    robots = [fs.load_robot(name) for name in ROBOTS]
    robots += [fs.load_robot(diamond)] if diamond.is_dir() else []
    print(
        "robot                 vertices  motion [mm]  "
        + "".join(f"{count:>7} bones" for count in COUNTS)
        + "   RMS (largest) [mm]"
    )
    for robot in robots:
        mesh = robot.body.mesh
        surface = np.unique(surface_triangles(mesh))
        rest, states = mesh.nodes[surface], random_states(robot)[:, surface]
        motion = rms_mm(np.linalg.norm(states - rest, axis=2))
        cells = []
        for count in COUNTS:
            found = fit_skin(rest, states[:40], bones=count)
            off = np.linalg.norm(skin_vertices(found, fit_poses(found, states[40:])) - states[40:], axis=2)
            cells.append(f"{rms_mm(off):.3f} ({1e3 * off.max():.2f})")
        print(f"{robot.name:<22}{len(rest):>8}{motion:>13.1f}  " + "".join(f"{cell:>13}" for cell in cells), flush=True)


def random_states(robot: fs.Robot) -> FloatArray:
    """Return nodes under 60 random inputs within limits, of about 10 mm motion where these allow it [m], shape (60, n, 3)."""
    body, rng = robot.body, np.random.default_rng(11)
    inputs = drive_inputs(robot)
    shares = rng.uniform(size=(60, len(inputs)))
    scale = 0.1
    for _ in range(6):  # so much of the limits as moves the nodes by 10 mm on average, from below: a body may not bear all
        rms = rms_mm(
            np.linalg.norm(np.array([state_of(body, inputs, scale * row) for row in shares[:6]]) - body.mesh.nodes, axis=2)
        )
        scale = min(1.0, scale * min(10.0 / rms, 2.0))
    return np.array([state_of(body, inputs, scale * row) for row in shares])


def state_of(body: fs.BodyModel, inputs: tuple[Input, ...], share: FloatArray) -> FloatArray:
    """Return nodes under shares of the ranges of the inputs [m], shape (n, 3)."""
    values = {one.name: one.low + s * (one.high - one.low) for one, s in zip(inputs, share)}
    tension = {name: values[name] for name in body.cable_names}
    found = fs.solve_equilibrium(body, tension=tension, pressure={name: values[name] for name in body.chamber_names})
    assert found.converged, found.status
    return found.positions


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", choices=PARTS, default=PARTS)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--states", type=Path, help="keep the states of the finger here")
    parser.add_argument("--keep", type=Path, help="keep the pieces of the arm here, and go on from them")
    parser.add_argument("--pieces", nargs="*", default=[], choices=(*SENSORS, "january", "days", "inside"), help="of the arm")
    arguments = parser.parse_args()
    if "speed" in arguments.only:
        speed()
    if "arm" in arguments.only and arguments.data.is_dir():
        arm(arguments.data, arguments.keep, arguments.pieces)
    if "actuator" in arguments.only:
        actuator(arguments.states)
    if "skin" in arguments.only:
        skin(arguments.data.parent / "diamond")


if __name__ == "__main__":
    main()
