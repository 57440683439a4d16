"""What is to be thought of a frame: its residual against what free frames leave, its forces against their uncertainty."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from femsense.calib.scan import Scan
from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import DataError
from femsense.fem.mesh import TetMesh
from femsense.sensing.measurement_rows import rows_at, seen_through
from femsense.sensing.nuisance import FAR_OFF, misfit, nuisance_excess
from femsense.sensing.places import away_from_scenery
from femsense.sensing.responses import response_at
from femsense.sensing.types import Fit, Sensor, Touch

OK = "ok"
SURE = 16.3
"""χ² with three degrees of freedom that noise alone gives once in 1000: a force below it is none."""
UNSETTLED = 0.5
"""Forces that were still changing are not believed where more than this share of the residual is left, unless that is noise."""

BESIDE, NEAR = 5.0, 0.01
"""Markers that are off by more than so many times the residual of the calibration, and this share of the body's diagonal, are not on the body.
On a soft beam whose touch was lost they were off by 9 to 60 times; in frames with the right forces by at most 1.7 times."""

BESIDE_SHAPE = (
    "an object is seen to touch where no contact was found, and a contact elsewhere that only the shape shows may be its own"
)
"""What a frame is said to be where an object touches that explains it no better than a place that nobody sees."""

UNKNOWN = "an object may touch whose force is not known"
"""What a frame is said to be whose other forces hold."""

VAGUE = 2.0
"""A place is vague that is known so many times worse than another one: that of a few points is by 3.5 times that of a ball (`arm-two --seed 5`)."""
ELSEWHERE = 3.0
"""Two places that lie farther apart than so many of their standard deviations are not the same."""

SQUEEZED = 0.6
"""Elements under a contact that are shorter than this share of their length are beyond the corotational law, and mostly beyond their mesh:
under a plate on a soft dome elements fall to 0 and the force is half of the true one; on bars and arms the least is 0.91."""


def status_of(sensor: Sensor, fit: Fit, free: Fit) -> str:
    """Return "ok", or in words why the result of a frame is not to be trusted.

    Not to be trusted is a residual far above what the free frames leave, with or without contacts, or a smooth error that is; a force that is
    less than its standard deviation while the frame is not explained; forces that were still changing; and a body squeezed beyond what its
    model holds for.
    """
    if fit.touches and not fit.still and fit.rows.rms > UNSETTLED * free.rows.rms + 3.0 * float(np.median(free.rows.std)):
        return f"the forces have not settled: {1e3 * fit.rows.rms:.2f} mm are left of {1e3 * free.rows.rms:.2f}"
    if fit.cost > free.cost or (fit.touches and fit.rows.rms > 1.05 * free.rows.rms + 2.0 * float(np.median(free.rows.std))):
        return "the residual is larger with the forces than without them"
    carrying = np.unique([node for touch in fit.touches for node in touch.patch.nodes])
    squeezed = least_stretch(sensor.robot.body.mesh, fit.state.positions, carrying)
    if squeezed < SQUEEZED:
        other = ", effect hyperelastic" if sensor.robot.body.material.law == "corotational" else ""
        return f"squeezed to {100 * max(squeezed, 0.0):.0f} % under a contact, beyond what law and mesh hold: finer mesh{other}"
    left = left_over(sensor, fit)
    if left > limit_of(sensor, fit):
        what = "with the contacts found" if fit.touches else "and no contact explains it"
        times = f"{exceeding(left / limit_of(sensor, fit))} free frames let expect"
        size = times if limit_of(sensor, fit) != FAR_OFF else f"{np.sqrt(left):.1f} standard deviations"
        return f"not explained: {1e3 * fit.rows.rms:.2f} mm are left, {size}, {what}"
    excess = shared_errors(sensor, fit)
    if excess > sensor.knowledge.nuisance_limit:
        more = exceeding(excess / sensor.knowledge.nuisance_limit)
        return f"not explained: a smooth error takes up what is left, {more} free frames and noise let expect"
    unsure = [i for i, f in enumerate(fit.forces) if np.linalg.norm(f) < _std_along(fit, i) and not unspoken(fit, i)]
    if unsure and fit.touches[unsure[0]].source != "given":
        return "a contact whose force is less than its standard deviation"
    return OK


def exceeding(square: float) -> str:
    """Return in words how far something is above a limit whose square it has so many times (> 1): a tenth more is not "1.1 times" that, and less not 1.0."""
    times = float(np.sqrt(square))
    return f"{times:.1f} times what" if times >= 2.0 else f"{max(round(100.0 * (times - 1.0)), 1)} % more than"


def beside_markers(sensor: Sensor, k: int, fit: Fit) -> str:
    """Return "ok", or in words how far the markers of frame k lie off what its cloud was taken for.

    Where the body is not where the model has it, what the cloud shows of it is taken for something else, and what is left fits well.
    """
    try:
        off = rows_at(sensor, k, None, fit.state).rms
    except DataError:
        return OK
    if off <= max(BESIDE * sensor.calibration.rms_m, NEAR * sensor.size):
        return OK
    color = (
        "" if sensor.robot.color_rgb is not None else "; without appearance.color_rgb parts of it are taken for something else"
    )
    return f"the markers lie {1e3 * off:.1f} mm off the body that was found in the cloud{color}"


def behind_body(sensor: Sensor, scan: Scan, fit: Fit) -> str:
    """Return "ok", or in words how much is seen behind the body where only the shape tells the robot's points from others.

    What the state does not explain is then left out as something else, and what is kept fits well.
    """
    share = 0.0 if scan.segmented else seen_through(sensor, scan, fit.state)
    if share <= sensor.knowledge.through_limit:
        return OK
    return (
        f"{100 * share:.0f} % of the points lie behind the body: parts of it may have been taken for something else; "
        "appearance.color_rgb and coloured clouds distinguish them"
    )


def chi_squared(fit: Fit) -> FloatArray:
    """Return how far each force of a fit is from none, squared, in standard deviations, shape (m,); 0 where none is known."""
    blocks = [fit.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] for i in range(len(fit.touches))]
    return np.array([float(f @ np.linalg.pinv(block) @ f) for f, block in zip(fit.forces, blocks)])


def first_to_go(fit: Fit, weak: Sequence[int]) -> int:
    """Return which of some contacts whose forces may be noise is left out first: the weakest of those whose places are known so much worse than another's.

    Where parts of one object are each taken for an object, they share its force and that of one beside them, so that all are weak. The weakest one of all
    may then be what is seen best.
    """
    least = min(fit.touches[i].std_m for i in weak)
    value = chi_squared(fit)
    vague = [i for i in weak if fit.touches[i].std_m > VAGUE * least]
    return min(vague or weak, key=lambda i: value[i])


def sure_forces(fit: Fit) -> tuple[bool, ...]:
    """Return whether each force of a fit is more than noise gives once in 1000."""
    return tuple(bool(v >= SURE) for v in chi_squared(fit))


def unspoken(fit: Fit, i: int) -> bool:
    """Return whether contact i is in the fit and not reported: an object touches there whose force may be none, beside a sure one."""
    if fit.touches[i].source != "cloud":
        return False
    value = chi_squared(fit)
    return bool(value[i] < SURE <= value.max())


def objects_known(fit: Fit, touching: Sequence[Touch], elsewhere: Sequence[Touch] = ()) -> str:
    """Return "ok", or in words that an object touches whose force may be none: beside a sure one, or where no contact is reported.

    One that carries less than how well the sure ones are known is part of their deviation, and not spoken of.

    Arguments:
        fit: of the frame.
        touching: those of its contacts, and of the places where completed objects touch the body, where nothing seems to touch in free frames.
        elsewhere: see `seen_elsewhere`.
    """
    if elsewhere:
        return BESIDE_SHAPE
    silent = [i for i, touch in enumerate(fit.touches) if any(touch is one for one in touching) and unspoken(fit, i)]
    most = [float(np.linalg.norm(fit.forces[i])) + 2.0 * _std_along(fit, i) for i in silent]
    sure = [_std_along(fit, i) for i, value in enumerate(chi_squared(fit)) if value >= SURE]
    if most and max(most) > max(sure):
        where = _at_rest(fit.touches[silent[int(np.argmax(most))]])
        return f"{UNKNOWN}, up to {max(most):.2g} N {where}, beside those that are reported"
    return f"{UNKNOWN}: too small to be sensed, {_at_rest(touching[0])}" if touching and not fit.touches else OK


def _at_rest(touch: Touch) -> str:
    return f"at [{', '.join(f'{1e3 * x:.0f}' for x in touch.place)}] mm of the body at rest"


def seen_elsewhere(sensor: Sensor, fit: Fit, found: Sequence[Touch]) -> list[Touch]:
    """Return where objects are seen to touch and the fit has no contact, if it has one that only the shape shows: that one may be theirs.

    Arguments:
        fit: of the frame.
        found: where completed objects touch in its state.
    """
    if all(touch.source != "shape" for touch in fit.touches):
        return []
    return [one for one in away_from_scenery(sensor, found) if not any(_at(sensor, fit, i, one) for i in range(len(fit.touches)))]


def _at(sensor: Sensor, fit: Fit, i: int, found: Touch) -> bool:
    """Return whether contact i is where an object touches, as well as the two places are known."""
    std = float(np.hypot(np.sqrt(np.trace(fit.place_covariance[i])), found.std_m))
    return float(np.linalg.norm(fit.touches[i].place - found.place)) < max(ELSEWHERE * std, sensor.surface.edge)


def left_over(sensor: Sensor, fit: Fit) -> float:
    """Return the misfit per row that a fit leaves, about 1 where all is explained."""
    return misfit(sensor.knowledge, fit.rows, _sag_of(sensor, fit))


def shared_errors(sensor: Sensor, fit: Fit) -> float:
    """Return χ² of the smooth errors that a fit needs over what is to be expected (see `nuisance_excess`)."""
    if not fit.rows.of_clouds:
        return 0.0
    return nuisance_excess(sensor.knowledge, fit.rows, _sag_of(sensor, fit))


def _sag_of(sensor: Sensor, fit: Fit) -> FloatArray:
    return response_at(sensor, fit.state).sag if fit.response is None else fit.response.sag


def least_stretch(mesh: TetMesh, positions: FloatArray, carrying: IntArray) -> float:
    """Return the least principal stretch of the elements that have one of some nodes [1]; negative where one is inside out, 1 without nodes.

    Arguments:
        mesh: at rest.
        positions: of its nodes [m], shape (n, 3).
        carrying: nodes that carry contacts, shape (k,).
    """
    tets = mesh.tets[np.isin(mesh.tets, carrying).any(axis=1), :4]
    if not len(tets):
        return 1.0
    rest, now = (np.swapaxes(x[tets[:, 1:]] - x[tets[:, :1]], 1, 2) for x in (mesh.nodes, positions))
    gradient = now @ np.linalg.inv(rest)
    return float((np.linalg.svd(gradient, compute_uv=False)[:, 2] * np.sign(np.linalg.det(gradient))).min())


def limit_of(sensor: Sensor, fit: Fit) -> float:
    """Return the misfit per row above which a fit does not explain its rows; free frames tell it of clouds only."""
    return sensor.knowledge.misfit_limit if fit.rows.of_clouds else FAR_OFF


def trusted(status: str) -> bool:
    """Return whether a frame may be the start of the next one: also where the force of one object beside sure ones is not known."""
    return status == OK or status.startswith(UNKNOWN)


def _std_along(fit: Fit, i: int) -> float:
    force = fit.forces[i]
    along = force / max(float(np.linalg.norm(force)), 1e-12)
    return float(np.sqrt(max(float(along @ fit.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] @ along), 0.0)))
