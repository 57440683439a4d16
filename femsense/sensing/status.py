"""The status of a frame, and the posterior check that sets it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import DataError
from femsense.fem.mesh import TetMesh
from femsense.sensing.contact_free import check_values
from femsense.sensing.marker_rows import marker_rows
from femsense.sensing.model import Fit, Model
from femsense.sensing.no_penetration import OVERLAPPING
from femsense.sensing.tracks import size_std

SQUEEZED = 0.6
"""Minimum principal stretch of the elements under a contact. Below it the law, and mostly the mesh, are not valid: under a plate on a soft dome
the stretch falls to 0; on bars and arms it is at least 0.91."""
MARKERS_OFF, MARKERS_FAR = 5.0, 0.01
"""Markers and cloud disagree if their distance exceeds this multiple of the calibration residual, and this share of the diagonal."""
MARKERS_MISFIT = 9.0
"""Maximum mean square of the whitened residuals of markers: three standard deviations everywhere."""
UNDETERMINED = 3.0
"""A force below this many standard deviations has no determined magnitude."""
UNKNOWN = 0.1
"""A latent force with a larger standard deviation can hide a contact [N]."""
OVERLAP = 3.0
"""Objects overlap the body if their gap is negative by more than this many standard deviations."""


class Status(Enum):
    """The status of a frame; the value is its text, with placeholders for numbers."""

    OK = "ok"
    PREDICTED = "no marker and no cloud: the model's prediction under the inputs"
    NOT_CONVERGED = "not converged: the forces still changed after the last step"
    SQUEEZED = "squeezed to {percent:.0f} % under a contact, beyond what the law and the mesh hold: its force may be far off"
    NOT_EXPLAINED = "not explained: {rms_mm:.2f} mm remain, {times:.2f} times the limit that contact-free frames set"
    NOT_EXPLAINED_MARKERS = "not explained: the markers are off by {times:.1f} standard deviations"
    LARGE_ERROR_FIELD = (
        "not explained: a smooth error takes up the residual, {times:.2f} times the limit that contact-free frames set"
    )
    BEHIND_BODY = "{percent:.0f} % of the points lie behind the body: parts of it may have been taken for something else; set appearance.color_rgb"
    MARKER_MISMATCH = "the markers lie {off_mm:.1f} mm off the body that was found in the cloud"
    OVERLAP = "an object overlaps the body by {overlap_mm:.1f} mm: its contact is missing or displaced"
    SEEN_ELSEWHERE = (
        "an object is seen to touch at [{where}] mm of the body at rest where no contact was found:"
        " the contact that only the shape shows may be its own"
    )
    MAY_TOUCH = "an object may touch whose force is not known, up to {force_n:.2f} N at [{where}] mm of the body at rest"
    UNDETERMINED = "contact, size not determined ({force_n:.2f} ± {std_n:.2f} N)"
    CAMERA_MOVED = (
        "{who} seems to have moved by {shift_mm:.1f} mm and {turn_deg:.1f}°, since the background did: that fits the frame better"
    )
    CAMERA_MAY_HAVE_MOVED = (
        "{who} or the robot's base may have moved by {shift_mm:.1f} mm and {turn_deg:.1f}°: that fits the frame as well"
    )


TRUSTED = (Status.OK, Status.SEEN_ELSEWHERE, Status.UNDETERMINED, Status.MAY_TOUCH)
"""Statuses with which a frame is the warm start of the next one."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """A status with its numbers."""

    status: Status
    numbers: tuple[tuple[str, float | str], ...] = ()

    def __str__(self) -> str:
        return self.status.value.format(**dict(self.numbers))

    @property
    def trusted(self) -> bool:
        """Whether the frame may be the warm start of the next one."""
        return self.status in TRUSTED


def verdict(status: Status, **numbers: float | str) -> Verdict:
    """Return a status with its numbers."""
    return Verdict(status, tuple(numbers.items()))


def checked(model: Model, best: Fit) -> Verdict:
    """Return the verdict of the posterior check on a fitted frame."""
    if best.contacts and not best.converged:
        return verdict(Status.NOT_CONVERGED)
    stretch = stretch_under_contacts(model, best)
    if stretch < SQUEEZED:
        return verdict(Status.SQUEEZED, percent=100.0 * max(stretch, 0.0))
    if best.frame.pixels is None:
        z = best.left(model.nuisance)
        if (z**2).mean() > MARKERS_MISFIT:
            return verdict(Status.NOT_EXPLAINED_MARKERS, times=float(np.sqrt((z**2).mean())))
    else:
        failed = _pixels_fail(model, best)
        if failed is not None:
            return failed
    for i, contact in enumerate(best.contacts):
        force, std = float(np.linalg.norm(best.forces[i])), std_along(best, i)
        if contact.source != "given" and force < UNDETERMINED * std:
            reported = std if force == 0.0 else size_std(best.forces[i], best.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3])
            return verdict(Status.UNDETERMINED, force_n=force, std_n=reported)
    inferred = any(contact.source == "shape" for contact in best.contacts)
    for one, (mean, std) in zip(best.frame.latent, best.latent_force):
        where = ", ".join(f"{1e3 * x:.0f}" for x in one.place)
        if inferred:
            return verdict(Status.SEEN_ELSEWHERE, where=where)
        if std > UNKNOWN:
            return verdict(Status.MAY_TOUCH, force_n=max(mean, 0.0) + 2.0 * std, where=where)
    return verdict(Status.OK)


def stretch_under_contacts(model: Model, best: Fit) -> float:
    """Return the least principal stretch of the elements that carry contacts [1]."""
    carrying = np.unique([node for contact in best.contacts for node in contact.patch.nodes])
    return least_stretch(model.sensor.robot.body.mesh, best.state.positions, carrying)


def _pixels_fail(model: Model, best: Fit) -> Verdict | None:
    limits = model.limits
    if limits is not None:
        misfit, nuisance, behind = check_values(model, best)
        if misfit > limits.misfit:
            own = best.responsibility * best.rows.pixel
            rms = float(np.sqrt(own @ best.rows.residual**2 / max(own.sum(), 1.0)))
            return verdict(Status.NOT_EXPLAINED, rms_mm=1e3 * rms, times=float(np.sqrt(misfit / limits.misfit)))
        if nuisance > limits.nuisance:
            return verdict(Status.LARGE_ERROR_FIELD, times=float(np.sqrt(nuisance / limits.nuisance)))
        if not best.frame.coloured and behind > limits.behind:
            return verdict(Status.BEHIND_BODY, percent=100.0 * behind)
    without_contact = ~best.rows.pixel & np.isclose(best.rows.log_other, np.log(OVERLAPPING))
    deep = best.rows.residual[without_contact & (best.rows.residual > OVERLAP * best.rows.std)]
    if len(deep):
        return verdict(Status.OVERLAP, overlap_mm=1e3 * float(deep.max()))
    try:
        off = marker_rows(model.sensor, best.frame.index, best.state, 0).residual
    except DataError:
        return None
    rms = float(np.sqrt((off**2).sum() / (len(off) / 3)))
    if rms > max(MARKERS_OFF * model.sensor.calibration.rms_m, MARKERS_FAR * model.sensor.size):
        return verdict(Status.MARKER_MISMATCH, off_mm=1e3 * rms)
    return None


def std_along(best: Fit, i: int) -> float:
    """Return the standard deviation of a force along its direction [N]; along the normal if the force is smaller than a thousandth of
    that."""
    force, covariance = best.forces[i], best.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
    normal = best.axes[i][0]
    across = float(np.sqrt(normal @ covariance @ normal))
    size = float(np.linalg.norm(force))
    along = force / size if size > 1e-3 * across else normal
    return float(np.sqrt(max(float(along @ covariance @ along), 0.0)))


def least_stretch(mesh: TetMesh, positions: FloatArray, carrying: IntArray) -> float:
    """Return the smallest principal stretch of the elements that contain some nodes [1]; negative if one is inverted, 1 without nodes.

    Arguments:
        mesh: at rest.
        positions: positions of its nodes [m], shape (n, 3).
        carrying: nodes that carry contacts, shape (k,).
    """
    tets = mesh.tets[np.isin(mesh.tets, carrying).any(axis=1), :4]
    if not len(tets):
        return 1.0
    rest, now = (np.swapaxes(x[tets[:, 1:]] - x[tets[:, :1]], 1, 2) for x in (mesh.nodes, positions))
    gradient = now @ np.linalg.inv(rest)
    return float((np.linalg.svd(gradient, compute_uv=False)[:, 2] * np.sign(np.linalg.det(gradient))).min())
