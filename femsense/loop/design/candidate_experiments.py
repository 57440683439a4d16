"""Candidate experiments with a robot and a camera, each as sweeps of a script.

A candidate starts and ends at rest, so that candidates can be combined in any order and analysed one by one. The size of a pull follows from the
declared robot: it moves a marker by a quarter of the robot's length, within the limits of the cable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import DataError
from femsense.core.parallel import each
from femsense.fem.equilibrium import Equilibrium, SolveOptions
from femsense.fem.newton_state import NewtonOptions
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.effects.loads import STANDARD_GRAVITY
from femsense.model.frame_state import solve_frame
from femsense.model.path_solver import LOOKED_AT
from femsense.model.recording import make_recording
from femsense.model.recording_parts import Drives, LoadRows, Timeline
from femsense.model.robot import Robot, spread_features
from femsense.rig.camera import camera_of, look_at, visible_points
from femsense.rig.scene import body_shape
from femsense.rig.script import FORMAT, SceneTable, ViewTable

BEND = 0.25
"""Displacement of a marker by a full pull, as a share of the robot's length."""
SAG = 0.08
"""Displacement of the tip by a weight, as a share of the robot's length."""
BEARABLE = 0.9
"""Largest pull as a share of the maximum tension or pressure."""
TOGETHER = 0.6
"""Share of a full pull for each of two cables that are pulled together."""
STEP_S = 1.0
SLOW_S = 10.0
HOLD_S = 15.0
"""Time between frames [s]: usual, slow, and while holding."""
MOST_EACH = 6
"""Maximum number of pairs of cables, of seeds of an effect and of frames of a recording, the most different ones first."""
FAR = 1.6
"""Distance of the second camera position relative to the first."""
DOWN = np.array([0.0, 0.0, -1.0])
"""Direction of the weight of a robot that declares none."""


@dataclass(frozen=True, eq=False, slots=True)
class Pull:
    """A cable or chamber, with the range of its input."""

    kind: str
    """"cables" or "chambers"."""
    name: str
    height: float
    """A full pull [N], [m] or [Pa]."""
    unit: str
    move: FloatArray
    """Displacement of the marker that moves most by a full pull, to first order [m], shape (3,)."""

    def words(self, share: float = 1.0) -> str:
        size = {"N": 1.0, "m": 1e3, "Pa": 1e-3}[self.unit] * share * self.height
        return f"{self.name} to {size:.3g} {({'N': 'N', 'm': 'mm', 'Pa': 'kPa'})[self.unit]}"


@dataclass(frozen=True, eq=False, slots=True)
class Setup:
    """A robot with the parameters of its experiments."""

    robot: Robot
    control: str
    zero: str
    """"absolute" or "unknown"."""
    pulls: tuple[Pull, ...]
    tip: FloatArray
    """Place of a weight at the tip [m], shape (3,)."""
    middle: FloatArray
    """Place of a weight half way to the tip [m], shape (3,)."""
    weight: float
    """Weight at the tip [N]."""
    gravity: FloatArray
    """Gravity with the base in its present orientation [m/s²], shape (3,)."""
    view: dict[str, Any]
    """The table [camera] of a script."""
    distance: float
    """Of the camera [m]."""

    def view_at(self, factor: float) -> dict[str, Any]:
        """Return the camera moved along its line of sight."""
        eye, target = np.array(self.view["eye_m"]), np.array(self.view["target_m"])
        return {**self.view, "eye_m": np.round(target + factor * (eye - target), 4).tolist()}


@dataclass(frozen=True, eq=False, slots=True)
class Element:
    """One candidate experiment."""

    key: str
    words: str
    sweeps: tuple[dict[str, Any], ...] = ()
    loads: tuple[dict[str, Any], ...] = ()
    far: bool = False
    """Recorded with the camera at a second distance, in a separate recording."""
    rest_file: bool = False
    """Not a sweep but a measurement for rest.csv."""

    @property
    def frames(self) -> int:
        return sum(len(s["levels"]) for s in self.sweeps)

    @property
    def seconds(self) -> float:
        return float(sum(len(s["levels"]) * s["dt_s"] for s in self.sweeps))


def script_of(setup: Setup, elements: Sequence[Element], *, noise: float, far: bool = False) -> dict[str, Any]:
    """Return the tables of a script (femsense-script-1) of some candidates, those of one camera distance."""
    chosen = [e for e in elements if e.far == far and e.sweeps]
    turned = any("gravity_m_s2" in s for e in chosen for s in e.sweeps)
    still = {"gravity_m_s2": setup.gravity.tolist()} if turned else {}
    document: dict[str, Any] = {
        "format": FORMAT,
        "actuation": setup.control,
        "actuation_zero": setup.zero,
        "dt_s": STEP_S,
        "sweeps": [{**still, **s} for e in chosen for s in e.sweeps],
        "loads": [dict(load) for e in chosen for load in e.loads],
        "camera": setup.view_at(FAR if far else 1.0),
        "markers": {"std_m": noise, "rest_file": any(e.rest_file for e in elements)},
        "scene": {"floor_z_m": round(float(setup.robot.body.mesh.nodes[:, 2].min()) - setup.robot.body.reach, 3)},
    }
    return document


# The candidates


def minimal(setup: Setup) -> list[Element]:
    """Return the minimal recording: the robot at rest, and each cable and chamber pulled up once."""
    return [Element("rest", "record the robot at rest", (_sweep("rest", [], [0.0]),)), *(_up(p) for p in setup.pulls)]


def candidate_experiments(setup: Setup) -> list[Element]:
    """Return all other candidates, in a fixed order."""
    leads = _leads(setup.pulls)
    items = [_unload(p) for p in setup.pulls]
    items += [_together(a, b) for a, b in _pairs(setup.pulls)]
    items += [_hold(p) for p in leads]
    items += [_slowly(p) for p in leads[:1]]
    items += [_hang(setup, where, leads[:1]) for where in ("tip", "middle")]
    if setup.robot.body.material.density > 0:
        items += [_turn(setup, i, leads[:1]) for i in range(2)]
    items.append(
        Element("rest.csv", "measure the markers on the unloaded body (held, lying or floating): rest.csv", rest_file=True)
    )
    items.append(_farther(setup, leads[:1]))
    return items


def _sweep(label: str, pulls: Sequence[tuple[Pull, float]], levels: list[float], dt: float = STEP_S) -> dict[str, Any]:
    result: dict[str, Any] = {"label": label, "levels": levels, "dt_s": dt}
    for kind in ("cables", "chambers"):
        values = {p.name: float(f"{share * p.height:.4g}") for p, share in pulls if p.kind == kind}
        if values:
            result[kind] = values
    return result


def _up(p: Pull) -> Element:
    return Element(f"up:{p.name}", f"pull {p.words()} in 3 steps", (_sweep(f"{p.name} up", [(p, 1.0)], [0.333, 0.667, 1.0]),))


def _unload(p: Pull) -> Element:
    words = f"pull {p.words()} with unloading at two levels: ½, ¼, full, ½, rest"
    return Element(f"unload:{p.name}", words, (_sweep(f"{p.name} up and down", [(p, 1.0)], [0.5, 0.25, 1.0, 0.5, 0.0]),))


def _together(a: Pull, b: Pull) -> Element:
    direction = "against each other" if _cosine(a, b) < -0.5 else "together"
    words = f"pull {a.words(TOGETHER)} and {b.words(TOGETHER)} {direction}, in 2 steps"
    return Element(
        f"mix:{a.name}+{b.name}", words, (_sweep(f"{a.name} and {b.name}", [(a, TOGETHER), (b, TOGETHER)], [0.5, 1.0]),)
    )


def _hold(p: Pull) -> Element:
    words = f"hold {p.words(0.5)} and then {p.words()} for a minute each, a frame every {HOLD_S:g} s, and let go"
    return Element(f"hold:{p.name}", words, (_sweep(f"{p.name} held", [(p, 1.0)], [0.5] * 4 + [1.0] * 4 + [0.0], HOLD_S),))


def _slowly(p: Pull) -> Element:
    words = f"pull {p.words()} and let go slowly, {SLOW_S:g} s a step: ½, full, ½, rest"
    return Element(f"slow:{p.name}", words, (_sweep(f"{p.name} slowly", [(p, 1.0)], [0.5, 1.0, 0.5, 0.0], SLOW_S),))


def _hang(setup: Setup, where: str, pulls: Sequence[Pull]) -> Element:
    """Return a weight at the tip, or twice that at half the length, where it moves the body less."""
    size = setup.weight if where == "tip" else 2.0 * setup.weight
    point = setup.tip if where == "tip" else setup.middle
    force = size * setup.gravity / np.linalg.norm(setup.gravity)
    label = f"weight at {where}"
    then = f", then pull {pulls[0].words()} in 2 steps" if pulls else ""
    words = f"hang a known weight of {1e3 * size / STANDARD_GRAVITY:.3g} g ({size:.3g} N, into loads.csv) at [{_place(point)}] m{then}"
    load = {"sweep": label, "point_m": np.round(point, 6).tolist(), "force_n": np.round(force, 6).tolist()}
    return Element(f"weight:{where}", words, (_sweep(label, [(p, 1.0) for p in pulls], [0.0, 0.5, 1.0]),), (load,))


def _turn(setup: Setup, i: int, pulls: Sequence[Pull]) -> Element:
    """Return a turn of the base, with a state at rest before it: the difference shows the weight."""
    aside = _aside(setup.gravity)[i]
    words = (
        f"turn the base by 90° together with its camera, so that weight points along [{_place(aside)}] "
        "(gravity_*_m_s2 in frames.csv), and record it at rest before and after"
    ) + (f", then pull {pulls[0].words()} in 2 steps" if pulls else "")
    still, turned = np.round(setup.gravity, 5).tolist(), np.round(aside * np.linalg.norm(setup.gravity), 5).tolist()
    before = {**_sweep(f"before turn {i + 1}", [], [0.0]), "gravity_m_s2": still}
    after = {**_sweep(f"turn {i + 1}", [(p, 1.0) for p in pulls], [0.0, 0.5, 1.0]), "gravity_m_s2": turned}
    return Element(f"turn:{i + 1}", words, (before, after))


def _farther(setup: Setup, pulls: Sequence[Pull]) -> Element:
    then = f", and pull {pulls[0].words()}" if pulls else ""
    words = f"move the camera to {FAR * setup.distance:.2g} m and record again at rest{then} (a second recording)"
    return Element("camera:far", words, (_sweep("seen from farther away", [(p, 1.0) for p in pulls], [0.0, 0.5, 1.0]),), far=True)


def _leads(pulls: Sequence[Pull]) -> list[Pull]:
    """Return the first pull and the one most perpendicular to it."""
    if len(pulls) < 2:
        return list(pulls)
    return [pulls[0], min(pulls[1:], key=lambda p: abs(_cosine(pulls[0], p)))]


def _pairs(pulls: Sequence[Pull]) -> list[tuple[Pull, Pull]]:
    """Return pairs of pulls, the most opposite ones first."""
    every = sorted(combinations(pulls, 2), key=lambda ab: _cosine(*ab))
    return every[:MOST_EACH]


def _cosine(a: Pull, b: Pull) -> float:
    return float(a.move @ b.move / max(float(np.linalg.norm(a.move) * np.linalg.norm(b.move)), 1e-300))


def _aside(gravity: FloatArray) -> FloatArray:
    """Return two unit vectors perpendicular to gravity and to each other, shape (2, 3)."""
    down = gravity / np.linalg.norm(gravity)
    first = np.eye(3)[int(np.argmin(np.abs(down)))]
    first = first - (first @ down) * down
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(down, first)])


def _place(point: FloatArray) -> str:
    return ", ".join(f"{v:.3g}" for v in np.round(point, 4) + 0.0)


# Size of pulls, and place of the camera


def setup_for(robot: Robot, control: str, zero: str = "absolute", *, most: FloatArray | None = None) -> Setup:
    """Return the parameters of the experiments on a robot.

    Arguments:
        robot: the declared robot.
        control: "tension" or "displacement".
        zero: "absolute" or "unknown".
        most: full pulls of the cables, if a recording has shown them [N] or [m], shape (a,).

    Raises:
        DataError: the robot has no equilibrium at rest.
    """
    body = robot.body
    own = np.linalg.norm(body.gravity)
    gravity = np.array(body.gravity) if own > 0 else STANDARD_GRAVITY * DOWN
    surface = body.mesh.nodes[spread_features(body, 40)]
    tip = surface[0]
    middle = surface[int(np.argmin(np.linalg.norm(surface - 0.5 * (tip + body.clamp_center), axis=1)))]
    slots = [("cables", c.name, c.max_tension if control == "tension" else np.inf) for c in body.cables]
    slots += [("chambers", c.name, c.max_pressure) for c in body.chambers]
    small = np.array([_small_step(robot, control, kind, top) for kind, _, top in slots])
    moves, sag = _moves(robot, control, small, tip, gravity)
    units = {"cables": "N" if control == "tension" else "m", "chambers": "Pa"}

    def pull(i: int) -> Pull:
        kind, name, top = slots[i]
        far = float(np.linalg.norm(moves[i]))
        height = min(BEND * body.reach / max(far, 1e-9) * small[i], BEARABLE * top)
        if most is not None and kind == "cables" and most[i] > 0:
            height = float(most[i])
        height = _bearable(robot, control, len(slots), i, float(f"{height:.2g}"))
        return Pull(kind, name, height, units[kind], moves[i] * height / small[i])

    pulls = tuple(each(pull, range(len(slots))))
    weight = float(f"{SAG * body.reach / max(sag, 1e-12):.2g}")
    view, distance = _camera(robot)
    return Setup(robot, control, zero, pulls, tip, middle, weight, gravity, view, distance)


def _small_step(robot: Robot, control: str, kind: str, top: float) -> float:
    if kind == "cables" and control == "displacement":
        return 2e-3 * robot.body.reach
    modulus = float(robot.body.material.young_modulus.mean())
    scale = 1e-4 * modulus * (1.0 if kind == "chambers" else 0.01 * robot.body.reach**2)
    return 0.01 * top if np.isfinite(top) else scale


def _still(robot: Robot, control: str, inputs: FloatArray, loads: LoadRows | None = None) -> DrivenRobot:
    """Return a quasi-static path over inputs of cables and chambers (F, a + c)."""
    a = len(robot.body.cables)
    recording = make_recording(
        Timeline(np.arange(len(inputs))),
        drives=Drives(
            robot.body.cable_names,
            inputs[:, :a],
            control,
            chamber_names=robot.body.chamber_names,
            pressures=inputs[:, a:],
        ),
        loads=loads,
    )
    return DrivenRobot(robot, drive_of(robot, recording))


def _moves(robot: Robot, control: str, small: FloatArray, tip: FloatArray, gravity: FloatArray) -> tuple[FloatArray, float]:
    """Return the displacement of the most affected marker by a small step of each pull (d, 3), and that by 1 N at the tip [m], to first order."""
    push = 1e-3 * gravity / np.linalg.norm(gravity)
    inputs = np.vstack([np.zeros(len(small)), np.diag(small), np.zeros(len(small))])
    loads = LoadRows([len(inputs) - 1], tip[None], push[None])
    driven = _still(robot, control, inputs, loads)

    def place(k: int, start: Equilibrium | None) -> tuple[Equilibrium, FloatArray]:
        state = solve_frame(driven, k, start=start, options=SolveOptions(single=True))
        if not state.converged:
            raise DataError(f"the declared robot has no equilibrium near rest: {state.status}: {state.advice}")
        return state, robot.markers.positions(state.positions)

    rest, places = place(0, None)
    change = np.array([there for _, there in each(lambda k: place(k, rest), range(1, len(inputs)))]) - places
    most = np.linalg.norm(change, axis=2).argmax(axis=1)
    best = change[np.arange(len(change)), most]
    return best[:-1], float(np.linalg.norm(best[-1]) / 1e-3)


def _bearable(robot: Robot, control: str, count: int, i: int, height: float) -> float:
    """Return a pull, reduced until the robot has an equilibrium within few steps."""
    soon = SolveOptions(single=True, newton=NewtonOptions(most_steps=LOOKED_AT))
    for _ in range(5):
        inputs = np.zeros((1, count))
        inputs[0, i] = height
        if solve_frame(_still(robot, control, inputs), 0, options=soon).converged:
            return height
        height = float(f"{0.6 * height:.2g}")
    raise DataError(f"no equilibrium at {height:g} of pull {i}: the declared robot is too soft for its cables")


def _camera(robot: Robot) -> tuple[dict[str, Any], float]:
    """Return the camera that sees most markers, from the side or from above, and its distance [m]."""
    target = np.round(robot.marker_points.mean(axis=0), 4)
    distance = float(f"{max(3.5 * robot.body.reach, 0.25):.2g}")
    shape = body_shape(robot, robot.body.mesh.nodes, SceneTable.model_validate({}))
    best: tuple[int, dict[str, Any]] | None = None
    for angle in np.arange(8) * np.pi / 4:
        for rise in (0.5, 0.1, 1.0):
            side = np.array([np.cos(angle) * np.cos(rise), np.sin(angle) * np.cos(rise), np.sin(rise)])
            eye = np.round(target + distance * side, 4)
            view = {"eye_m": eye.tolist(), "target_m": target.tolist()}
            lens = camera_of(ViewTable.model_validate(view))
            seen = int(visible_points(lens, look_at(eye.tolist(), target.tolist()), [shape], robot.marker_points).sum())
            best = (seen, view) if best is None or seen > best[0] else best
    assert best is not None
    return best[1], distance
