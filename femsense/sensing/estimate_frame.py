"""Contacts and forces of one frame: predict, fit the contacts of the frame before, propose and fit others while J falls, add what touches besides.

docs/method/estimator.md has the objective J (`Fit.criterion`), the proposals and the posterior check.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray
from femsense.core.errors import DataError
from femsense.fem.equilibrium import Equilibrium
from femsense.inference.rows import Rows
from femsense.model.drive import has_history
from femsense.sensing.camera_moved import camera_verdict
from femsense.sensing.contact_free import FEWEST
from femsense.sensing.fit import TOLERANCE, fit
from femsense.sensing.law import BETWEEN, moved_by_law, moved_by_zones
from femsense.sensing.model import Fit, Frame, Model, pixels_of
from femsense.sensing.no_penetration import is_with
from femsense.sensing.objects_of_frame import touching_objects, with_expected_objects, with_segmented_objects
from femsense.sensing.places import away_from_scenery, case_of, given_touches, object_touches
from femsense.sensing.proposals import SAME, Proposal, elsewhere, is_alike, proposals
from femsense.sensing.run_arrays import sensed
from femsense.sensing.states import free_state
from femsense.sensing.status import SQUEEZED, checked, stretch_under_contacts
from femsense.sensing.touches import without_object
from femsense.sensing.tracks import contacts_of
from femsense.sensing.types import Case, FrameReport, Refuted, SensedFrame, Touch
from femsense.sensing.undetermined import with_undetermined

ROUNDS, FITTED = 8, 4
"""Maximum number of rounds of proposals, and of proposals fitted in each."""
REMEMBERED = 10
"""Number of frames in which the error of a refuted proposal is used."""


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
    covariances = covariances_of(model, best)
    places = best.place_covariance + elsewhere(model, best)
    contacts = contacts_of(sensor, k, best.contacts, best.forces, covariances, places, best.state, previous)
    stages = {**found.stages_ms, "check": 1e3 * (time.perf_counter() - began)}
    report = FrameReport(
        frame=int(sensor.recording.frame_numbers[k]),
        time_s=float(sensor.recording.time_s[k]),
        status=str(status),
        contacts=len(sensed(contacts)),
        matched=measurements(best.rows),
        rms_before_m=found.rms_before_m,
        rms_after_m=rms_of(best.rows, best.of_robot),
        ms=sum(stages.values()),
        tension_n=dict(best.state.tension),
        pressure_pa=dict(best.state.pressure),
        stages_ms=stages,
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
        refuted=best.frame.refuted,
    )


def estimate_frame(model: Model, k: int, previous: SensedFrame | None) -> Estimate:
    """Return the hypothesis of frame k: no contact, forces at the given places, or the contacts at which a local search for the lowest J ends.

    Arguments:
        model: of the recording.
        k: index 0 … F − 1.
        previous: the frame before; None at the beginning.

    Raises:
        FemsenseError: a broken file, no pixel of the robot, or no equilibrium.
    """
    clock = Clock()
    frame = _predicted(model, k, previous, clock)
    if frame.case is Case.CONTACT_FREE:
        best = _without_contacts(model, frame)
        clock.lap("fit")
    elif frame.case is Case.GIVEN_PLACES:
        best = _at_given_places(model, frame, previous)
        clock.lap("fit")
    else:
        start = _carried_over(model, frame, previous)
        best = _without_contacts(model, frame) if start is None else start
        clock.lap("fit")
        best = with_undetermined(model, *_searched(model, best))
    clock.lap("search")
    before = rms_of(_without_forces(best), best.of_robot)
    clock.lap("rms")
    return Estimate(best, before, clock.stages)


def covariances_of(model: Model, best: Fit) -> list[FloatArray]:
    """Return the covariance of the force of each contact [N²], each (3, 3): of the fit, of the compliance, of the
    constitutive law, and of the zones of line and face contacts."""
    model_errors = np.vstack([BETWEEN * moved_by_law(model, best), moved_by_zones(model, best)])
    result = []
    for i, force in enumerate(best.forces):
        own = slice(3 * i, 3 * i + 3)
        moved = model_errors[:, own]
        result.append(best.covariance[own, own] + model.compliance_std**2 * np.outer(force, force) + moved.T @ moved)
    return result


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


# --- search ---------------------------------------------------------------------------------------------------------------


def _searched(model: Model, best: Fit) -> tuple[Fit, list[Touch]]:
    """Return the fit at which no proposal lowers J any more, after ROUNDS at most, and where visible objects touch there. The first proposal that lowers J
    is taken."""
    for _ in range(ROUNDS):
        best = with_segmented_objects(model, best)
        touching = touching_objects(model, best)
        lower, refuted = _lower(model, best, touching)
        if lower is None:
            return replace(best, frame=replace(best.frame, refuted=refuted)), touching
        best = lower
    return best, touching_objects(model, best)


def _lower(model: Model, best: Fit, touching: Sequence[Touch]) -> tuple[Fit | None, tuple[Refuted, ...]]:
    """Return the first fit of a proposal with a lower J, or None; and the proposals from the same contacts that were refuted.

    A fit costs hundreds of times its linear prediction, whose error hardly changes from frame to frame: after a refutation, the expected decrease of J is
    reduced by the error of that time.

    Arguments:
        touching: where visible objects touch.
    """
    refuted = [one for one in best.frame.refuted if is_alike(model, one.before, best.contacts)]
    for proposal in _promising(model, best, touching, refuted)[:FITTED]:
        start = best.state if best.contacts and proposal.contacts else best.frame.predicted
        fitted = fit(model, best.frame, proposal.contacts, proposal.forces, start, eta=best.eta, tau=proposal.tau)
        decrease = 0.0 if fitted is None else best.criterion - fitted.criterion
        if fitted is not None and decrease > TOLERANCE:
            return fitted, ()
        refuted.append(Refuted(best.frame.index, best.contacts, proposal.contacts, proposal.gain - decrease))
    return None, tuple(refuted)


def _promising(model: Model, best: Fit, touching: Sequence[Touch], refuted: Sequence[Refuted]) -> list[Proposal]:
    """Return the proposals that may lower J, the most promising first.

    Where contacts squeeze the body beyond its law, more of them would only stand in for what law and mesh lack.
    """
    most = len(best.contacts) if stretch_under_contacts(model, best) < SQUEEZED else np.inf
    promising = []
    for proposal in proposals(model, best, touching):
        errors = [one.error for one in refuted if is_alike(model, one.contacts, proposal.contacts)]
        if len(proposal.contacts) <= most and (not errors or proposal.gain > max(errors)):
            promising.append(proposal)
    return promising


# --- predict ------------------------------------------------------------------------------------------------------------


def _predicted(model: Model, k: int, previous: SensedFrame | None, clock: Clock) -> Frame:
    """Return the frame with its predicted state, its pixels, and the objects near the body."""
    case = case_of(model.sensor, k)
    tensions = previous.state.segment_tensions if previous is not None and has_history(model.sensor.robot) else None
    predicted = free_state(model.sensor, k, None if previous is None else previous.free_state, tensions)
    clock.lap("equilibrium")
    expected = _expected(predicted, previous)
    scan = pixels_of(model, k, expected)
    clock.lap("read")
    if scan is None:
        return Frame(k, case, None, None, predicted, tensions)
    if len(scan.view) < FEWEST:
        near = len(scan.view) + len(scan.others)
        if not near:
            whole = "has points, but none near the robot: check unit and pose" if len(scan.far) else "is empty"
            raise DataError(f"no point of the robot in view: the cloud {whole}")
        raise DataError(
            f"only {len(scan.view)} of {near} points near the body are the robot's: check the pose, appearance.color_rgb, and what the camera sees"
        )
    pixels = model.pixels(scan)
    if not pixels.coloured:  # most pixels show other things than the robot
        pixels = pixels.anchored(model.skin, expected.positions)
    seen, refuted = ((), ()) if previous is None else (previous.objects, previous.refuted)
    refuted = tuple(one for one in refuted if k - one.frame <= REMEMBERED)
    frame = Frame(k, case, pixels, scan, predicted, tensions, seen_before=seen, refuted=refuted)
    if case is Case.UNKNOWN_CONTACTS:
        frame = with_expected_objects(model, frame, expected)
    clock.lap("objects")
    return frame


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
    """Return the fit of the previous frame's contacts, or that without contacts where it has the lower J; None without previous contacts.

    The fit without contacts is asked for only if the evidence of a contact is below its prior odds.
    """
    if previous is None or not previous.touches or not previous.trusted:
        return None
    start = _expected(frame.predicted, previous)
    seen = away_from_scenery(model.sensor, object_touches(model.sensor, frame.objects, start))
    kept = [i for i, contact in enumerate(previous.touches) if not contact.undetermined]
    if not kept:
        return None
    contacts = [_followed(model, previous.touches[i], seen) for i in kept]
    carried = fit(model, frame, contacts, previous.forces[kept], start, tau=previous.tau[kept])
    if carried is None or (carried.drop_gain > carried.odds).all():
        return carried
    alone = _without_contacts(model, frame)
    return carried if carried.criterion < alone.criterion else alone


def _followed(model: Model, contact: Touch, touching: Sequence[Touch]) -> Touch:
    """Return a contact of the previous frame where its object touches now, or where another one touches near it; without either it is inferred."""
    if contact.source == "cloud":
        with_object = next((touch for touch in touching if is_with(contact, touch.shape)), None)
        if with_object is not None:
            return with_object
        distance = [float(np.linalg.norm(touch.place - contact.place)) for touch in touching]
        if distance and min(distance) < max(SAME * model.sensor.size, 2.0 * touching[int(np.argmin(distance))].std_m):
            return touching[int(np.argmin(distance))]
    return contact if contact.source == "shape" else without_object(model.sensor, contact)


def _at_given_places(model: Model, frame: Frame, previous: SensedFrame | None) -> Fit:
    """Return the fit with forces at the given places, whatever its evidence; that without contacts if there is no equilibrium.

    Without colour, the body may be far from the state by which its pixels were separated from the others. There a wide initial κ is tried as well, and
    once more from where this fit ends.
    """
    given = given_touches(model.sensor)
    forces, start = np.zeros((len(given), 3)), frame.predicted
    if previous is not None and len(previous.touches) == len(given):
        forces, start = previous.forces, _expected(frame.predicted, previous)
    fits = [fit(model, frame, given, forces, start)]
    if not frame.coloured:
        fits.append(fit(model, frame, given, forces, start, catch=np.inf))
        if (last := fits[-1]) is not None:
            fits.append(fit(model, frame, last.contacts, last.forces, last.state, tau=last.tau, catch=np.inf))
    found = [fitted for fitted in fits if fitted is not None]
    return min(found, key=lambda fitted: fitted.criterion) if found else _without_contacts(model, frame)


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
