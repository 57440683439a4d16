"""Estimates from the contact-free frames: the prior of the nuisance parameters, the noise, its overdispersion, and the odds of an inferred
contact."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.stats import chi2

from femsense.calib.from_clouds import free_clouds
from femsense.calib.other_law import with_other_law
from femsense.core.arrays import FloatArray, freeze
from femsense.core.errors import FemsenseError
from femsense.core.pose import moved_poses
from femsense.inference.error_field import facing_of
from femsense.inference.nuisance import first_nuisance, fit_nuisance, gram_of, learnt, without_poses
from femsense.inference.pixels import Skin
from femsense.inference.rows import Rows
from femsense.model.quasi_static_path import free_path
from femsense.model.recording_checks import how_to_free
from femsense.sensing.background import background_of
from femsense.sensing.fit import fit
from femsense.sensing.law import neo_hookean
from femsense.sensing.model import STRAY, Fit, Frame, Limits, Model, block_of, pixels_of
from femsense.sensing.odds import INFERRED
from femsense.sensing.prepare import pose_covariance
from femsense.sensing.proposals import inferred_gain
from femsense.sensing.types import Case, Sensor

MODULUS_STD_BESIDE_PULLS, PULL_STD = 0.01, 0.05
"""Maximum prior σ of the relative modulus if cable pulls are nuisance parameters too (the two are nearly collinear), and prior σ of each
relative pull."""
FEWEST = 30
"""Minimum number of robot pixels of a contact-free frame."""
SEVERAL = 4
"""Minimum number of contact-free frames for leave-one-out estimates of the gain of a false contact."""
AWAY = (5.0, 15.0)
"""Range of whitened residuals [σ] in which the density of mixed pixels is estimated. Closer ones, which matter for the fit, are assumed to
be as dense."""
FLAG = 1e-3
"""False-alarm probability of the posterior check of the nuisance parameters, per frame."""


@dataclass(frozen=True, eq=False, slots=True)
class ContactFree:
    """A contact-free frame."""

    frame: Frame
    fit: Fit


def learn(sensor: Sensor) -> Model:
    """Return the model of a recording: what its contact-free frames teach, or the prior alone where there are none.

    The states are neo-Hookean where the robot declares no law, unless a contact-free frame has no such equilibrium, as of chambers at high pressures.
    """
    sensor = replace(sensor, declares_law=with_other_law(sensor.robot) is None)
    likely = neo_hookean(sensor)
    model = prior_model(sensor if likely is None or _lacks_states(likely) else likely)
    for turn in range(2):
        frames = _contact_free(model)
        if not frames:
            _warn_of_none(sensor)
            return model
        model = _taught(model, [one.fit for one in frames])
        if turn == 0:
            model = _at_the_mean(model, [one.fit for one in frames])
    frames = _contact_free(model)
    if not frames:
        return model
    background = background_of(model.sensor, frames[0].frame.index)  # with the estimated poses
    return _with_limits(replace(model, sensor=replace(model.sensor, background=background)), frames)


def _warn_of_none(sensor: Sensor) -> None:
    recording = sensor.recording
    if not recording.has_clouds:
        return
    if free_clouds(recording):
        what = (
            f"in the frames that are marked as free the camera sees less than {FEWEST} points of the robot, or the body has no equilibrium; check unit and"
            " content of the clouds, the pose, and appearance.color_rgb"
        )
    elif recording.free is not None and recording.free.any():
        what = "those that are marked have no cloud; mark others in which nothing touches the robot"
    else:
        what = f"mark frames in which nothing touches the robot {how_to_free(recording)}"
    warnings.warn(
        "no contact-free frame can be used: camera pose, noise and model error are those declared, and no status checks whether the model explains a"
        f" frame; {what}",
        stacklevel=2,
    )


def _lacks_states(sensor: Sensor) -> bool:
    """Return whether a contact-free frame has no equilibrium under its inputs."""
    frames = free_clouds(sensor.recording)
    return len(list(free_path(sensor.driven, frames))) < len(frames)


def prior_model(sensor: Sensor) -> Model:
    """Return the model before any contact-free frame is seen."""
    nodes, triangles = sensor.robot.body.mesh.nodes, sensor.surface.triangles
    skin = Skin(triangles, nodes, freeze(facing_of(nodes[triangles])), sensor.error_field, sensor.pivot, sensor.size)
    pulls = sensor.recording.actuation == "displacement" and sensor.recording.has_clouds
    drives = len(sensor.robot.body.cables) + len(sensor.robot.body.chambers) if pulls else 0
    modulus = min(sensor.options.modulus_std, MODULUS_STD_BESIDE_PULLS) if drives else sensor.options.modulus_std
    covariance = block_diag(pose_covariance(sensor.recording, sensor.calibration), np.diag([modulus**2] + [PULL_STD**2] * drives))
    nuisance = first_nuisance(np.zeros(len(covariance)), covariance, len(sensor.error_field), len(sensor.calibration.poses))
    return Model(sensor, skin, nuisance, sensor.knowledge.noises, inferred_odds=INFERRED, block=block_of(sensor))


def _contact_free(model: Model) -> list[ContactFree]:
    """Return the contact-free frames, each fitted without contacts. Frames without a fit are left out."""
    result = []
    for k, state in free_path(model.sensor.driven, free_clouds(model.sensor.recording)):
        try:
            scan = pixels_of(model, k, state)
            if scan is None or len(scan.view) < FEWEST:
                continue
            marked = model.drives > 0 and bool((model.sensor.recording.marker_frame == k).any())
            frame = Frame(k, Case.CONTACT_FREE, model.pixels(scan), scan, state, None, with_markers=marked)
            found = fit(model, frame, (), np.zeros((0, 3)), state)
        except FemsenseError:
            continue
        if found is not None:
            result.append(ContactFree(frame, found))
    return result


def _taught(model: Model, frames: Sequence[Fit], *, sizes: tuple[float, float, float] | None = None) -> Model:
    """Return the model with noise, overdispersion and prior estimated from contact-free frames."""
    nuisance, scale, T = model.nuisance, 1.0, model.overdispersion
    for _ in range(2):
        grams, left, seen = [], [], np.zeros(3)
        for one in frames:
            rows = _rescaled(one.rows, scale, T)
            N, residual = one.C @ nuisance.root, rows.residual - one.C @ nuisance.mean
            eta, _, weight = fit_nuisance(rows, residual, N, np.zeros(N.shape[1]))
            grams.append(gram_of(rows, one.C, weight))
            z = (residual - N @ eta) / rows.std
            seen += _stray(rows, z, weight * T * rows.std**2, model.skin.size)
            left.append((np.where(rows.pixel & (weight * T * rows.std**2 > 0.5), z, np.nan), rows.rest))
        scale *= float(np.clip(1.4826 * np.nanmedian(np.abs(np.concatenate([z for z, _ in left]))), 0.3, 30.0))
        T = _overdispersion(left, 0.5 * model.skin.field.length)
        nuisance = learnt(nuisance, grams, sizes=sizes)
    front, behind = (1.0 + seen[:2]) / (1.0 + seen[2])  # posterior mean of a Poisson rate under an exponential prior of mean 1
    # Objects that touch add mixed pixels in front of the body.
    return replace(model, nuisance=nuisance, scale=model.scale * scale, overdispersion=T, stray=(max(front, 1.0), behind))


def _stray(rows: Rows, z: FloatArray, robot: FloatArray, length: float) -> FloatArray:
    """Return the number of pixels within AWAY in front of the surface and behind it, and the number expected under STRAY, shape (3,).

    z, robot: whitened residuals and probability that a row is the robot's, shape (r,).
    """
    near, far = AWAY
    expected = (far - near) * STRAY / length * float(robot[rows.pixel] @ rows.std[rows.pixel])
    return np.array([(rows.pixel & (near < side) & (side < far)).sum() for side in (z, -z)] + [expected])


def _rescaled(rows: Rows, scale: float, T: float) -> Rows:
    """Return the rows with another noise and overdispersion of pixels; markers keep theirs."""
    return replace(rows, std=np.where(rows.pixel, scale, 1.0) * rows.std, share=np.where(rows.pixel, 1.0 / T, rows.share))


def _overdispersion(left: Sequence[tuple[FloatArray, FloatArray]], cell: float) -> float:
    """Return T ≥ 1: variance of sums of whitened residuals over cells of the surface, relative to that of independent pixels."""
    sums = squares = 0.0
    for z, rest in left:
        robot = np.isfinite(z)
        label = np.unique(np.floor(rest[robot] / cell).astype(np.int64), axis=0, return_inverse=True)[1].ravel()
        sums += float((np.bincount(label, z[robot]) ** 2).sum())
        squares += float((z[robot] ** 2).sum())
    return max(1.0, sums / max(squares, 1e-9))


def _at_the_mean(model: Model, frames: Sequence[Fit]) -> Model:
    """Return the model re-linearised at the estimated poses and modulus, so that rays and states are close to the true ones.

    If pulls are nuisance parameters, a large pose error compensated by an opposite error field fits slightly better than small ones of
    both. The error field is then made orthogonal to the pose.
    """
    v, sensor, nuisance = 6 * model.views, model.sensor, model.nuisance
    shown = nuisance.mean[: nuisance.common]
    if model.drives:
        grams = [without_poses(gram_of(one.rows, one.C, one.weight), v, nuisance.common) for one in frames]
        shown = learnt(nuisance, grams, sizes=nuisance.sizes).mean[: nuisance.common]
    poses = tuple(freeze(T) for T in moved_poses(sensor.calibration.poses, -shown[:v], sensor.pivot))
    robot = replace(sensor.robot, body=sensor.robot.body.with_stiffness_scale(1.0 / (1.0 + shown[v])))
    first = np.concatenate([-shown[:v], [1.0 / (1.0 + shown[v]) - 1.0], np.zeros(model.drives)])
    sensor = replace(
        sensor,
        robot=robot,
        driven=replace(sensor.driven, robot=robot),
        calibration=replace(sensor.calibration, poses=poses, T_robot_camera=poses[0]),
    )
    nuisance = first_nuisance(first, model.nuisance.first_covariance, len(model.skin.field), model.views)
    return replace(model, sensor=sensor, nuisance=nuisance, modulus_shift=float(shown[v]))


def _with_limits(model: Model, frames: Sequence[ContactFree]) -> Model:
    """Return the model with the odds of an inferred contact and the limits of the posterior check, by leave-one-out over the contact-free
    frames."""
    fits = [one.fit for one in frames]
    gains, checks = [], []
    for i, one in enumerate(frames):
        others = model
        if len(frames) >= SEVERAL:
            others = _taught(model, [f for j, f in enumerate(fits) if j != i], sizes=model.nuisance.sizes)
            others = replace(others, scale=model.scale, overdispersion=model.overdispersion, inferred_odds=0.0)
        alone = fit(others, one.frame, (), np.zeros((0, 3)), one.frame.predicted)
        assert alone is not None
        if len(frames) >= SEVERAL:
            gains.append(max(inferred_gain(others, alone), 0.0))
        checks.append(check_values(others, alone))
    odds = max(INFERRED, max(gains) + 3.0 * float(np.std(gains))) if gains else INFERRED
    noises = tuple(
        replace(one, at_1m=model.scale * one.at_1m, floor=model.scale * one.floor, slope=model.scale * one.slope)
        for one in model.noises
    )
    bias, share = model.nuisance.sizes[:2]
    together = model.overdispersion
    knowledge = replace(model.sensor.knowledge, noises=noises, bias_m=bias, model_share=share, together=together)
    sensor = replace(model.sensor, knowledge=knowledge)
    misfit, nuisance, behind = np.array(checks).T
    limits = Limits(_limit(misfit, 0.05), max(1.0, _limit(nuisance, 0.05)), _limit(behind, 0.01))
    return replace(model, sensor=sensor, inferred_odds=odds, limits=limits)


def check_values(model: Model, found: Fit) -> tuple[float, float, float]:
    """Return the statistics of the posterior check: misfit per pixel, |η̃|² over its quantile at level FLAG, and the share of pixels behind the body.

    Whitened residuals are capped at five. Without colour that separates the robot, the misfit is that of the pixels assigned to the robot.
    With
    A = Nᵀ W N, the fitted η̃ has the covariance A (A + 1)⁻¹; its |η̃|² is that of a gamma distribution with the same mean and variance
    (Satterthwaite 1946).
    """
    pixels, q = found.rows.pixel, model.nuisance.root.shape[1]
    z = found.left(model.nuisance)[pixels]
    robot = np.ones(len(z)) if found.frame.coloured else found.responsibility[pixels]
    N = found.N[:, :q]
    seen = np.maximum(np.linalg.eigvalsh((N * found.weight[:, None]).T @ N), 0.0)
    share = seen / (1.0 + seen)
    degrees = share.sum() ** 2 / max(float((share**2).sum()), 1e-12)
    expected = share.sum() / max(degrees, 1e-12) * float(chi2.isf(FLAG, degrees)) if degrees > 0.0 else 1.0
    behind = float((found.rows.residual[pixels] < -4.0 * found.rows.std[pixels]).mean())
    misfit = float(robot @ np.minimum(z**2, 25.0) / max(robot.sum(), 1.0))
    return misfit, float((found.eta[:q] ** 2).sum()) / max(expected, 1e-12), behind


def _limit(seen: FloatArray, least: float) -> float:
    """Return the limit of a statistic: its maximum over the contact-free frames plus three standard deviations, each at least `least`."""
    return float(seen.max() + 3.0 * max(float(seen.std()), least))
