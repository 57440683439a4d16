"""Whether cameras that moved explain a frame as well as contacts that only the shape shows, or better than contacts that are seen: six numbers of each
camera, with rays of their own.

Near its clamp, a body that is pushed moves about as one does before a camera that was nudged; what stands around it stays where it is, or moves with
it. One step of the pose does not tell: many rays then meet another face than they would from the true pose. It tells where to ask.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from femsense.calib.scan import Scan
from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import FemsenseError
from femsense.core.pose import moved_poses
from femsense.sensing.background import NOTHING, Glance, look, off_background
from femsense.sensing.forces import fit_forces, no_forces
from femsense.sensing.judge import OK, SURE, left_over, shared_errors
from femsense.sensing.measurement_rows import rows_at
from femsense.sensing.nuisance import HUBER, OUTLIER, SELDOM, misfit_of, nuisance_columns, robust_std
from femsense.sensing.responses import response_at
from femsense.sensing.types import Fit, Rows, Sensor, Start

FAR = 0.1
"""How far a camera may have moved, in radians and shares of the body's diagonal: so far that this does not hold it."""
CATCHING, STEPS = 8, 8
"""Steps of the pose at most: first with points whose rays miss the body, too, then by rays alone."""
ROUNDS = 4
"""How often poses are searched and what objects do is fitted from there, in turn: a force that was fitted before took up a part of the way."""
STILL, NEAR = 0.1, 1e-3
"""A step that changes the cost by less, or the poses by less than this share of FAR, is the last one."""


@dataclass(frozen=True, eq=False, slots=True)
class Moved:
    """A frame as cameras that moved explain it."""

    step: FloatArray
    """(rotation about the pivot [rad], shift [m]) of all poses, shape (6 v,)."""
    sensor: Sensor
    """With the cameras there."""
    fit: Fit
    """With the contacts that objects make."""
    cost: float
    """Of that fit, of the background, and of the step."""
    stood: float
    """What the background costs where no camera moved."""
    beside: float
    """What it costs from there, with that of the step."""


def camera_status(
    sensor: Sensor, k: int, scan: Scan, fit: Fit, free: Fit, before: tuple[FloatArray, ...] | None, status: str
) -> str:
    """Return the status of a frame, or in words that a camera that moved explains it as well.

    Asked is a frame whose contacts only the shape shows, or that is not explained; and one whose contacts are seen where six numbers of each camera explain
    more of it than noise makes of them once in 1000.

    Arguments:
        scan: what is the robot's.
        fit, free: of the frame, with its contacts and without.
        before: tensions along the cables until now (friction).
        status: what is thought of the fit.
    """
    unseen, limit = sum(touch.source == "shape" for touch in fit.touches), _limit(sensor)
    seen = status == OK and not unseen
    if seen and _gain_of_poses(sensor, k, scan, fit) < limit:
        return status
    moved = moved_cameras(sensor, k, scan, fit, free, before)
    if moved is None or not any(_farthest(sensor, moved)[1:]):
        return status
    better = moved.cost < fit.cost + moved.stood - SURE
    if unseen and moved.cost < fit.cost + moved.stood + SURE:
        than = "better than" if better else "about as well as"
        return f"{_in_words(sensor, moved)} the frame {than} the contact{'s' * (unseen > 1)} that only the shape shows"
    more, behind = moved.cost < fit.cost + moved.stood - limit, moved.beside < moved.stood - limit
    if more and (seen or (behind and fit.touches and not unseen)):
        return f"{_in_words(sensor, moved)} the frame better than its contacts alone"
    explained = left_over(moved.sensor, moved.fit) <= sensor.knowledge.misfit_limit
    if status != OK and better and explained and shared_errors(moved.sensor, moved.fit) <= sensor.knowledge.nuisance_limit:
        return f"{_in_words(sensor, moved)} what is left"
    return status


def _limit(sensor: Sensor) -> float:
    """Return what six numbers of each camera gain by noise alone once in 1000."""
    return float(chi2.isf(SELDOM, 6 * len(sensor.calibration.poses)))


def _gain_of_poses(sensor: Sensor, k: int, scan: Scan, fit: Fit) -> float:
    """Return how much less a frame costs with steps of its poses beside its forces, to first order."""
    if not fit.touches:
        return 0.0
    glance = NOTHING if sensor.background is None else look(sensor, k)
    n = len(fit.state.positions)
    loads = np.array([touch.patch.spread(axis, n) for touch in fit.touches for axis in np.eye(3)])
    forces = fit.rows.functional(response_at(sensor, fit.state, fit.response).tangent.respond(loads))
    return _Search(sensor, k, scan, fit, glance).gain_beside(forces)


def moved_cameras(sensor: Sensor, k: int, scan: Scan, fit: Fit, free: Fit, before: tuple[FloatArray, ...] | None) -> Moved | None:
    """Return the poses that explain frame k best with those contacts of a fit alone that objects make; None where nothing is to be seen from there."""
    glance, stood = NOTHING if sensor.background is None else look(sensor, k), np.zeros(6 * len(sensor.calibration.poses))
    best: Moved | None = None
    try:
        base, step = _of_objects(sensor, k, scan, fit, free, before), stood
        for _ in range(ROUNDS if base.touches else 1):
            search = _Search(sensor, k, scan, base, glance)
            step = search.best(step)
            there = _at(sensor, step)
            base, beside = _of_objects(there, k, scan, fit, free, before), search.beside(step)
            if best is not None and base.cost + beside > best.cost - SURE:
                break
            best = Moved(step, there, base, base.cost + beside, search.beside(stood), beside)
    except FemsenseError:
        return best
    return best


def _of_objects(sensor: Sensor, k: int, scan: Scan, fit: Fit, free: Fit, before: tuple[FloatArray, ...] | None) -> Fit:
    """Return the fit of those contacts alone that objects make; that without forces where there are none."""
    alone = no_forces(sensor, k, scan, free.state, free.response)
    own = [i for i, touch in enumerate(fit.touches) if touch.source == "cloud"]
    if not own:
        return alone
    start = Start(fit.state, fit.forces[own], fit.response)
    return fit_forces(sensor, k, scan, [fit.touches[i] for i in own], alone, start=start, before=before)


def _at(sensor: Sensor, step: FloatArray) -> Sensor:
    """Return the sensor with its cameras moved by a step, shape (6 v,)."""
    poses = tuple(freeze(T) for T in moved_poses(sensor.calibration.poses, step, sensor.pivot))
    return replace(sensor, calibration=replace(sensor.calibration, poses=poses, T_robot_camera=poses[0]))


class _Search:
    """Gauss–Newton steps of the poses to the points of the robot and of the background, the body held as it is."""

    def __init__(self, sensor: Sensor, k: int, scan: Scan, base: Fit, glance: Glance) -> None:
        self.sensor, self.k, self.scan, self.base, self.glance = sensor, k, scan, base, glance
        self.wide = np.tile(np.repeat([FAR, FAR * sensor.size], 3), len(sensor.calibration.poses))
        self.sag = response_at(sensor, base.state, base.response).sag

    def best(self, stood: FloatArray) -> FloatArray:
        """Return the step of all poses that costs least, searched from one on, shape (6 v,)."""
        near, change = stood, self.wide
        for _ in range(CATCHING):
            if np.abs(change / self.wide).max() < NEAR:
                break
            last, near = near, self.farther(self.rows(near, caught=True), near)
            change = near - last
        return min((self.descended(start) for start in (near, stood)), key=lambda found: found[0])[1]

    def descended(self, step: FloatArray) -> tuple[float, FloatArray]:
        """Return what the best of some steps costs that lead on from one, and that step."""
        best = np.inf, step
        for _ in range(STEPS):
            rows = self.rows(step)
            cost = self.misfit(rows) + self.beside(step)
            gain = best[0] - cost
            best = min(best, (cost, step), key=lambda found: found[0])
            if abs(gain) < STILL:
                break
            step = self.farther(rows, step)
        return best

    def rows(self, step: FloatArray, *, caught: bool = False) -> Rows:
        """Return the robot's rows from there."""
        return rows_at(_at(self.sensor, step), self.k, self.scan, self.base.state, caught=caught)

    def misfit(self, rows: Rows) -> float:
        """Return what the robot's rows cost."""
        columns, known = nuisance_columns(self.sensor.knowledge, rows, self.sag)
        return misfit_of(rows.residual - known, columns, rows)[0]

    def beside(self, step: FloatArray) -> float:
        """Return what a step costs beside the robot's rows: itself, and the background from there."""
        off = self.around(step)[0]
        return float(((step / self.wide) ** 2).sum() + (np.minimum(np.abs(off), OUTLIER) ** 2).sum() / self.base.rows.together)

    def around(self, step: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return how far the background's points are off from there, and how that moves with the poses (see `off_background`)."""
        background, poses = self.sensor.background, _at(self.sensor, step).calibration.poses
        if background is None or not len(self.glance.view):
            return np.zeros(0), np.zeros((0, len(self.wide)))
        return off_background(self.sensor, background, self.glance, poses)

    def farther(self, rows: Rows, step: FloatArray) -> FloatArray:
        """Return a step to the least squares of the rows and the background, linear about one step."""
        A, b = self.equations(rows, step)
        q = len(step)
        prior = np.append(np.zeros(A.shape[1] - q), -step / self.wide)
        solved = np.linalg.solve(A.T @ A + np.eye(A.shape[1]), A.T @ b + prior)
        return np.asarray(step + self.wide * solved[-q:])

    def gain_beside(self, forces: FloatArray) -> float:
        """Return how much less the rows and the background cost with a step of the poses beside forces (r, 3m) [m/N], linear about none."""
        A, b = self.equations(self.base.rows, np.zeros(len(self.wide)), self.sensor.options.force_std_n * forces)
        q = len(self.wide)
        return _explained(A, b) - _explained(A[:, :-q], b)

    def equations(self, rows: Rows, step: FloatArray, beside: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Return rows and background, whitened, by other columns (r, j), nuisance and unit steps of the poses; and what they are off, linear about one step."""
        columns, known = nuisance_columns(self.sensor.knowledge, rows, self.sag)
        columns = columns if beside is None else np.hstack([beside, columns])
        residual = rows.residual - known
        off, by_pose = self.around(step)
        weight = np.sqrt(np.minimum(1.0, HUBER / np.maximum(np.abs(off), 1e-9)) / rows.together)
        own = np.hstack([columns, -self.wide * rows.by_pose]) / robust_std(rows, residual)[:, None]
        other = np.hstack([np.zeros((len(off), columns.shape[1])), -self.wide * by_pose]) * weight[:, None]
        return np.vstack([own, other]), np.append(residual / robust_std(rows, residual), weight * off)


def _explained(A: FloatArray, b: FloatArray) -> float:
    """Return how much of the squares of b (r,) unit numbers with columns A (r, q) explain."""
    right = A.T @ b
    return float(right @ np.linalg.solve(A.T @ A + np.eye(A.shape[1]), right))


def _in_words(sensor: Sensor, moved: Moved) -> str:
    """Return which camera moved farthest and how far, as sure as the background tells."""
    farthest, shift, turn = _farthest(sensor, moved)
    name, far = sensor.recording.camera_names[farthest], f"{shift:.1f} mm and {turn:.1f}°"
    who = f"camera {name}" if name else "the camera"
    if moved.beside < moved.stood - SURE:
        return f"{who} seems to have moved by {far}, since the background did: that explains"
    return f"{who} or the robot's base may have moved by {far}: that would explain"


def _farthest(sensor: Sensor, moved: Moved) -> tuple[int, float, float]:
    """Return which camera moved farthest, how far [mm] and by how much it turned [°], both to the tenth that a status states."""
    steps = moved.step.reshape(-1, 6)
    farthest = int(np.argmax(np.linalg.norm(steps / np.repeat([1.0, sensor.size], 3), axis=1)))
    turn, shift = np.degrees(np.linalg.norm(steps[farthest, :3])), 1e3 * np.linalg.norm(steps[farthest, 3:])
    return farthest, round(float(shift), 1), round(float(turn), 1)
