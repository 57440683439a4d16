"""Contacts and forces of one frame: predict, propose, fit, keep the best, stop.

The objective J, the proposals and the posterior check are defined in docs/method/estimator.md.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray
from femsense.core.errors import DataError
from femsense.fem.equilibrium import Equilibrium
from femsense.inference.mixture import misfit
from femsense.inference.rows import Rows
from femsense.model.drive import has_history
from femsense.pointcloud.primitives import Shape
from femsense.sensing.camera_moved import camera_verdict
from femsense.sensing.contact_free import FEWEST
from femsense.sensing.fit import TOLERANCE, fit
from femsense.sensing.model import Fit, Frame, Model, pixels_of
from femsense.sensing.no_penetration import COMPLETED, gap_std, in_touch, is_rigid, is_with
from femsense.sensing.places import away_from_scenery, given_touches, object_touches, objects_near, said_free
from femsense.sensing.proposals import SAME, elsewhere, proposals
from femsense.sensing.run_arrays import sensed
from femsense.sensing.states import free_state
from femsense.sensing.status import SQUEEZED, UNDETERMINED, checked, std_along, stretch_under_contacts
from femsense.sensing.tracks import contacts_of
from femsense.sensing.types import FrameReport, SensedFrame, Touch

ROUNDS, FITTED = 8, 4
"""Maximum number of rounds of proposals, and of proposals fitted in each."""
UNDETERMINED_TAU = 2.0
"""Prior scale of a force at a touching object that the data do not determine [N]: the usual force of hands and grippers."""
MANY = 30
"""Minimum number of pixels of an object without a known shape that can carry a latent force."""


@dataclass(frozen=True, eq=False, slots=True)
class Estimate:
    """The estimate of a frame."""

    best: Fit
    rms_before_m: float
    """Residual of the predicted state: along the normal for pixels, in 3-D for markers [m]."""
    stages_ms: dict[str, float]


def sense(model: Model, k: int, previous: SensedFrame | None) -> SensedFrame:
    """Return contacts, forces and status of frame k. Raises FemsenseError."""
    found = estimate_frame(model, k, previous)
    best, sensor = found.best, model.sensor
    began = time.perf_counter()
    status = camera_verdict(model, best, checked(model, best))
    stages = {**found.stages_ms, "check": 1e3 * (time.perf_counter() - began)}
    covariances = [covariance_of(model, best, i) for i in range(len(best.contacts))]
    places = best.place_covariance + elsewhere(model, best)
    contacts = contacts_of(sensor, k, best.contacts, best.forces, covariances, places, best.state, previous)
    report = FrameReport(
        int(sensor.recording.frame_numbers[k]),
        float(sensor.recording.time_s[k]),
        str(status),
        len(sensed(contacts)),
        measurements(best.rows),
        found.rms_before_m,
        rms_of(best.rows, inliers(best)),
        sum(stages.values()),
        dict(best.state.tension),
        dict(best.state.pressure),
        stages,
    )
    state = replace(best.state, factor=None)
    return SensedFrame(
        best.contacts,
        state,
        best.forces,
        best.frame.predicted,
        report,
        contacts,
        tau=best.tau,
        trusted=status.trusted,
        objects=best.frame.objects,
    )


def estimate_frame(model: Model, k: int, previous: SensedFrame | None) -> Estimate:
    """Return the hypothesis of frame k with the lowest J.

    Raises:
        FemsenseError: a broken file, no pixel of the robot, or no equilibrium.
    """
    clock = Clock()
    frame = _predicted(model, k, previous, clock)
    start = _carried_over(model, frame, previous)
    best = start if start is not None else _without_contacts(model, frame)
    clock.lap("fit")
    if said_free(model.sensor, k):
        pass
    elif given := given_touches(model.sensor):
        best = _at_given_places(model, frame, given, best, previous)
    else:
        best = _with_objects_in_touch(model, *_searched(model, best))
    clock.lap("search")
    before = rms_of(_without_forces(best), inliers(best))
    clock.lap("state")
    return Estimate(best, before, clock.stages)


def covariance_of(model: Model, best: Fit, i: int) -> FloatArray:
    """Return the covariance of the force of contact i [N²], shape (3, 3): that of the fit plus that of the model's compliance."""
    force = best.forces[i]
    own = best.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
    return np.asarray(own + model.compliance_std**2 * np.outer(force, force))


def inliers(best: Fit) -> BoolArray:
    """Return which measured rows belong to the robot with probability above one half, shape (r,)."""
    return np.asarray((best.responsibility > 0.5) & (best.rows.pixel if best.rows.pixel.any() else True))


def rms_of(rows: Rows, robot: BoolArray) -> float:
    """Return the root mean square residual [m] of the robot's pixels along the normal, or of markers in 3-D."""
    own = rows.residual[robot[: len(rows)]] if rows.pixel.any() else rows.residual.reshape(-1, 3)
    return float(np.sqrt((own**2).sum() / max(len(own), 1))) if len(own) else float("nan")


def _without_forces(best: Fit) -> Rows:
    """Return the rows of a fit with the residual of the predicted state, at the same points of the body."""
    back = best.state.positions - best.frame.predicted.positions
    return replace(best.rows, residual=best.rows.residual + best.rows.of(back[None])[:, 0])


def measurements(rows: Rows) -> int:
    """Return the number of pixels, or of markers."""
    return int(rows.pixel.sum()) if rows.pixel.any() else len(rows) // 3


def _searched(model: Model, best: Fit) -> tuple[Fit, list[Touch]]:
    """Return the best fit, after no proposal lowers J any more, and the contacts of observed objects there."""
    for _ in range(ROUNDS):
        best = _with_objects(model, best)
        seen = _seen(model, best)
        better = next((found for found in _fits(model, best, seen) if found.criterion < best.criterion - TOLERANCE), None)
        if better is None:
            return best, seen
        best = better
    return best, _seen(model, best)


def _seen(model: Model, best: Fit) -> list[Touch]:
    """Return the contacts of observed objects with the body in the state of a fit."""
    return away_from_scenery(model.sensor, object_touches(model.sensor, best.frame.objects, best.state))


def _with_objects(model: Model, best: Fit) -> Fit:
    """Return a fit with the objects near the body in its fitted state. Without colour, objects consist of the pixels in front that the
    mixture does not assign to the robot."""
    frame = best.frame
    if frame.scan is None or said_free(model.sensor, frame.index):
        return best
    if not frame.coloured:
        objects = _in_front(model, frame, best.rows, inliers(best), best.state)
    elif _moved_by(frame.objects_at, best.state) > model.sensor.surface.edge:
        objects = tuple(objects_near(model.sensor, frame.scan, best.state, frame.seen_before))
        frame = replace(frame, objects_at=best.state.positions)
        best = replace(best, frame=frame)
    else:
        return best
    if len(objects) == len(frame.objects) and all(_is_alike(model, a, b) for a, b in zip(objects, frame.objects)):
        return best
    seen = replace(frame, objects=objects)
    again = fit(model, seen, best.contacts, best.forces, best.state, eta=best.eta, tau=best.tau, linearised=best.linearised)
    return best if again is None else again


def _moved_by(positions: FloatArray | None, state: Equilibrium) -> float:
    """Return the largest distance of a node from an earlier position [m]; 0 if there is none."""
    return 0.0 if positions is None else float(np.linalg.norm(state.positions - positions, axis=1).max())


def _in_front(model: Model, frame: Frame, rows: Rows, robot: BoolArray, state: Equilibrium) -> tuple[Shape, ...]:
    """Return the objects formed by the pixels in front of a state that do not belong to the robot; robot: responsibilities, shape (r,)."""
    assert frame.scan is not None
    pixels = rows.pixel
    other = ~robot[pixels] & (rows.residual[pixels] > 0.0)
    scan = replace(frame.scan, others=frame.scan.camera_points[other], others_view=frame.scan.view[other])
    return tuple(objects_near(model.sensor, scan, state, frame.seen_before))


def _is_alike(model: Model, first: Shape, second: Shape) -> bool:
    """Return whether two shapes are the same within the uncertainty of their surfaces. The visible extent of a plate or rod does not
    matter."""
    ways = {"plate": first.axes[2:], "cylinder": first.axes[1:]}.get(first.kind, first.axes)
    apart = float(np.linalg.norm(ways @ (first.center - second.center)))
    return first.kind == second.kind and apart < max(gap_std(model, first), gap_std(model, second))


def _with_objects_in_touch(model: Model, best: Fit, touching: Sequence[Touch]) -> Fit:
    """Return the best hypothesis, refitted with the touching objects whose force the data do not determine.

    A touching object that is not a contact of the hypothesis has no significant force. Without its force, the forces of its neighbours
    would be biased and their intervals too narrow. If its surface lies at the body's, it becomes a contact with a wide interval, otherwise
    a latent force. Visible contacts with insignificant forces are treated alike: if two tips squeeze a body, the pixels determine only the
    difference of their forces, and the smallest τ would set both to zero.
    """
    others = [t for t in touching if _is_object(t) and not any(is_with(c, t.shape) for c in best.contacts)]
    at_surface = [replace(t, undetermined=True) for t in others if in_touch(model, t, best.state.positions)]
    latent = [t for t in others if not any(is_with(c, t.shape) for c in at_surface)]
    if at_surface or latent:
        best = _fitted_wide(model, replace(best, frame=replace(best.frame, latent=tuple(latent))), at_surface)
    return _fitted_wide(model, best, ()) if any(_unsized(model, best)) else best


def _unsized(model: Model, best: Fit) -> list[bool]:
    """Return which visible contacts have an insignificant force, with a prior scale that was fitted to it."""
    return [
        is_rigid(model, contact) and not contact.undetermined and float(np.linalg.norm(force)) < UNDETERMINED * std_along(best, i)
        for i, (contact, force) in enumerate(zip(best.contacts, best.forces))
    ]


def _fitted_wide(model: Model, best: Fit, more: Sequence[Touch]) -> Fit:
    """Return a hypothesis refitted with additional contacts. These and the insignificant ones have the wide prior. The other visible
    contacts start from it, because their τ was estimated while their counterparts had no force.
    """
    unsized = _unsized(model, best)
    tau = [UNDETERMINED_TAU if is_rigid(model, contact) else own for contact, own in zip(best.contacts, best.tau)]
    again = fit(
        model,
        best.frame,
        [*(replace(c, undetermined=c.undetermined or wide) for c, wide in zip(best.contacts, unsized)), *more],
        np.vstack([best.forces, np.zeros((len(more), 3))]),
        best.state,
        eta=best.eta,
        tau=np.append(tau, np.full(len(more), UNDETERMINED_TAU)),
        linearised=best.linearised,
    )
    return best if again is None else again


def _is_object(contact: Touch) -> bool:
    """Return whether a contact is with an object of known shape, or with one of at least MANY pixels."""
    shape = contact.shape
    return shape is not None and (shape.kind in COMPLETED or len(shape.points) >= MANY)


def _fits(model: Model, best: Fit, seen: Sequence[Touch]) -> Iterator[Fit]:
    """Yield fits of the most promising proposals, one after the other; seen: contacts of observed objects.

    If contacts squeeze the body beyond the range of its law, no contact is added: it would compensate the error of law and mesh.
    """
    most = len(best.contacts) if stretch_under_contacts(model, best) < SQUEEZED else np.inf
    for one in [one for one in proposals(model, best, seen) if len(one.contacts) <= most][:FITTED]:
        start = best.state if best.contacts and one.contacts else best.frame.predicted
        found = fit(model, best.frame, one.contacts, one.forces, start, eta=best.eta, tau=one.tau)
        if found is not None:
            yield found


# --- predict ------------------------------------------------------------------------------------------------------------


def _predicted(model: Model, k: int, previous: SensedFrame | None, clock: Clock) -> Frame:
    """Return the frame with its predicted state, its pixels, and the objects near the body."""
    tensions = previous.state.segment_tensions if previous is not None and has_history(model.sensor.robot) else None
    predicted = free_state(model.sensor, k, None if previous is None else previous.free_state, tensions)
    clock.lap("equilibrium")
    expected = _expected(predicted, previous)
    scan = pixels_of(model, k, expected)
    clock.lap("read")
    if scan is None:
        return Frame(k, None, None, predicted, tensions)
    if len(scan.view) < FEWEST:
        raise DataError(
            f"only {len(scan.view)} points of the robot in view: check the pose, appearance.color_rgb, and what the camera sees"
        )
    seen = () if previous is None else previous.objects
    pixels = model.pixels(scan)
    if not pixels.coloured:  # most pixels belong to something else
        pixels = pixels.anchored(model.skin, expected.positions)
    frame = Frame(k, pixels, scan, predicted, tensions, seen_before=seen)
    objects: tuple[Shape, ...] = ()
    objects_at: FloatArray | None = None
    if not len(model.sensor.places) and not said_free(model.sensor, k):
        if scan.segmented:
            objects, objects_at = tuple(objects_near(model.sensor, scan, expected, seen)), expected.positions
        elif expected is not predicted:
            rows = model.rows(frame, expected)
            objects = _in_front(
                model, frame, rows, misfit(rows.residual / rows.std, rows.log_other, rows.share)[1] > 0.5, expected
            )
    clock.lap("objects")
    return replace(frame, objects=objects, objects_at=objects_at)


def _expected(predicted: Equilibrium, previous: SensedFrame | None) -> Equilibrium:
    """Return an approximate state of the body: the previous state plus the change of the predicted one."""
    if previous is None or not previous.touches or not previous.trusted:
        return predicted
    moved = previous.state.positions + predicted.positions - previous.free_state.positions
    return replace(previous.state, positions=moved)


def _without_contacts(model: Model, frame: Frame) -> Fit:
    found = fit(model, frame, (), np.zeros((0, 3)), frame.predicted)
    if found is None:
        raise DataError("the body is unstable under its inputs")
    return found


def _carried_over(model: Model, frame: Frame, previous: SensedFrame | None) -> Fit | None:
    """Return the fit of the previous frame's contacts if removing any of them would raise J; else None."""
    if (
        previous is None
        or not previous.touches
        or not previous.trusted
        or len(model.sensor.places)
        or said_free(model.sensor, frame.index)
    ):
        return None
    start = _expected(frame.predicted, previous)
    seen = away_from_scenery(model.sensor, object_touches(model.sensor, frame.objects, start))
    kept = [i for i, contact in enumerate(previous.touches) if not contact.undetermined]
    if not kept:
        return None
    contacts = [_followed(model, previous.touches[i], seen) for i in kept]
    found = fit(model, frame, contacts, previous.forces[kept], start, tau=previous.tau[kept])
    if found is None:
        return None
    alone = None if (found.drop_gain > found.odds).all() else _without_contacts(model, frame)
    return found if alone is None or found.criterion < alone.criterion else alone


def _followed(model: Model, contact: Touch, seen: Sequence[Touch]) -> Touch:
    """Return a contact of the previous frame at its object, or at another object that now touches near it; without either, as an inferred
    contact."""
    if own := next((one for one in seen if contact.source == "cloud" and is_with(contact, one.shape)), None):
        return own
    distance = [float(np.linalg.norm(one.place - contact.place)) for one in seen] if contact.source == "cloud" else []
    if distance and min(distance) < max(SAME * model.sensor.size, 2.0 * seen[int(np.argmin(distance))].std_m):
        return seen[int(np.argmin(distance))]
    if contact.source == "shape":
        return contact
    std = float(np.sqrt(model.sensor.surface.area.sum() / (2.0 * np.pi)))
    return replace(contact, source="shape", std_m=std, line=np.zeros(3), expected=contact.place, shape=None, pulls=False)


def _at_given_places(model: Model, frame: Frame, given: Sequence[Touch], alone: Fit, previous: SensedFrame | None) -> Fit:
    """Return the fit with forces at the given contact points, whatever its evidence."""
    forces, start = np.zeros((len(given), 3)), frame.predicted
    if previous is not None and len(previous.touches) == len(given):
        forces, start = previous.forces, _expected(frame.predicted, previous)
    tried = [fit(model, frame, given, forces, start)]
    if not frame.coloured:  # the body may be far from the state in which its pixels were separated from the rest
        tried.append(fit(model, frame, given, forces, start, catch=np.inf))
        if (near := tried[-1]) is not None:  # restart from there with a wide noise
            tried.append(fit(model, frame, near.contacts, near.forces, near.state, tau=near.tau, catch=np.inf))
    found = [one for one in tried if one is not None]
    return min(found, key=lambda one: one.criterion) if found else alone


class Clock:
    """Durations of the stages of a frame [ms]."""

    def __init__(self) -> None:
        self.began = self.last = time.perf_counter()
        self.stages: dict[str, float] = {}

    @property
    def total_ms(self) -> float:
        """Time since the start [ms]."""
        return 1e3 * (time.perf_counter() - self.began)

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.stages[name] = self.stages.get(name, 0.0) + 1e3 * (now - self.last)
        self.last = now
