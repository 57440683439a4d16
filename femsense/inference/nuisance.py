"""Nuisance parameters η: causes of residuals other than contact forces, with a Gaussian prior estimated from contact-free frames.

    η = (pose step of each camera, relative softness, relative pull of each cable and chamber, error field b of each camera, error field m of the model)
    r = C(x) η + noise,   C = [∂r/∂pose, d·∂x/∂softness, d·∂x/∂pulls, k by camera, |x − x_rest| k]

Contact-free frames i have η_i = (θ, e + e_i): θ and e are common to all, e_i is each frame's own error. With b = s_b·unit, m = s_m·unit
and the share a of their variance that is common, θ and e have the posterior of a linear Gaussian model in which e_i is marginalised;
(s_b, s_m, a) maximise its evidence over a grid (type-II maximum likelihood, MacKay 1992). A new frame has η ~ N(μ, R Rᵀ) with the posterior of (θ, e)
and the prior of its own e_i.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from femsense.core.arrays import FloatArray, IntArray, freeze
from femsense.inference.mixture import misfit
from femsense.inference.rows import Rows

BIAS_M = 5e-6 * 2.0 ** np.arange(10)
MODEL_SHARE = 0.000625 * 2.0 ** np.arange(8)
COMMON = (0.0, 0.5, 0.8, 0.95)
"""Grid of s_b [m], s_m [1] and a [1]."""
EXPECTED, SIZE_FACTOR = np.array([1e-4, 0.01]), 8.0
"""Prior of s_b and s_m: log-normal about these, within this factor at one standard deviation."""
EM_STEPS, EM_TOLERANCE = 8, 0.1
"""Maximum number of steps of a fit of η, and the decrease of Φ at which it ends."""


@dataclass(frozen=True, eq=False, slots=True)
class Nuisance:
    """The Gaussian prior of the nuisance parameters in the next frame.

    There are c common parameters (pose steps of v cameras, softness, pulls) and v + 1 error fields with p centres each, one per camera and one of the model.
    """

    first_mean: FloatArray
    """Mean of the common parameters before any frame is used, shape (c,)."""
    first_covariance: FloatArray
    """Its covariance, shape (c, c)."""
    mean: FloatArray
    """Mean μ of all parameters, shape (c + (v + 1) p,)."""
    root: FloatArray
    """Root R of their covariance R Rᵀ, shape (c + (v + 1) p, q)."""
    centres: int
    """Number p of centres of each error field."""
    sizes: tuple[float, float, float] = (1e-4, 0.01, 0.0)
    """Standard deviation of the cameras' error fields [m]; of the model's error field, relative to the displacement [1]; share of their variance that is common
    to all frames [1]."""

    @property
    def common(self) -> int:
        """Number of parameters outside of the error fields."""
        return len(self.first_mean)

    @property
    def fields(self) -> IntArray:
        """Index in `sizes` of the standard deviation of each parameter of the error fields (0: camera, 1: model), shape ((v + 1) p,)."""
        count = len(self.mean) - self.common
        return np.repeat([0, 1], [count - self.centres, self.centres])


def first_nuisance(mean: FloatArray, covariance: FloatArray, centres: int, views: int) -> Nuisance:
    """Return the prior before contact-free frames are used.

    Arguments:
        mean: prior mean of pose steps, softness and pulls, shape (c,).
        covariance: their prior covariance, shape (c, c).
        centres: number of centres of each error field.
        views: number of cameras; each has an error field, and the model has one.

    Returns:
        the prior, with error fields of mean zero and of the standard deviations `EXPECTED`.
    """
    root = block_diag(root_of(covariance), np.diag(np.repeat(EXPECTED, [views * centres, centres])))
    full = freeze(np.append(mean, np.zeros((views + 1) * centres)))
    return Nuisance(freeze(mean), freeze(covariance), full, freeze(root), centres)


def columns(rows: Rows, softening: FloatArray) -> FloatArray:
    """Return the derivative of the residual rows by the nuisance parameters: pose steps, softness and pulls, then error fields.

    Arguments:
        rows: r residual rows, with the poses of v cameras and error fields with p centres.
        softening: node displacements for a unit of relative softness and of each of a pulls [m], shape (1 + a, n, 3) with n nodes.

    Returns:
        C, shape (r, c + (v + 1) p), with c = 6 v + 1 + a.
    """
    by_camera = (rows.camera[:, :, None] * rows.field[:, None]).reshape(len(rows), -1)
    return np.hstack([rows.by_pose, rows.of(softening), by_camera, rows.way[:, None] * rows.field])


def fit_nuisance(
    rows: Rows, residual: FloatArray, N: FloatArray, eta: FloatArray, *, kappa: FloatArray | float = 1.0, steps: int = EM_STEPS
) -> tuple[FloatArray, float, FloatArray]:
    """Fit the nuisance parameters of one frame by expectation maximisation.

    The parameters are whitened, with a standard normal prior: η = μ + R η̃. The objective Φ is the misfit of the rows, in which each row may belong to
    another object, plus ‖η̃‖².

    Arguments:
        rows: r residual rows.
        residual: residual at the prior mean μ [m], shape (r,).
        N: derivative of the residual by the q whitened parameters [m], shape (r, q).
        eta: whitened parameters from which the iteration starts, shape (q,).
        kappa: factor on the standard deviation of the noise [1], a number or shape (r,).
        steps: maximum number of iterations.

    Returns:
        the whitened parameters, shape (q,); Φ; the weight of each row [1/m²], shape (r,).
    """
    last = np.inf
    for _ in range(steps):
        phi, weight = misfit((residual - N @ eta) / rows.std, rows.log_other, rows.share, kappa)
        phi += float(eta @ eta)
        if last - phi < EM_TOLERANCE:
            break
        last = phi
        W = weight * rows.share / (kappa * rows.std) ** 2
        NW = N * W[:, None]
        eta = np.asarray(np.linalg.solve(np.eye(N.shape[1]) + NW.T @ N, NW.T @ residual), dtype=np.float64)
    phi, weight = misfit((residual - N @ eta) / rows.std, rows.log_other, rows.share, kappa)
    return eta, phi + float(eta @ eta), weight * rows.share / (kappa * rows.std) ** 2


def gram_of(rows: Rows, C: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the weighted inner products of the nuisance parameters' columns and the residual of one frame: its normal equations.

    Arguments:
        rows: the r residual rows of the frame.
        C: derivative of the residual by each of the k nuisance parameters, result of `columns`, shape (r, k).
        weight: weight of each row [1/m²], shape (r,).

    Returns:
        (C, residual)ᵀ diag(weight) (C, residual), shape (k + 1, k + 1).
    """
    A = np.hstack([C, rows.residual[:, None]])
    return np.asarray((A * weight[:, None]).T @ A)


def learnt(nuisance: Nuisance, grams: Sequence[FloatArray], *, sizes: tuple[float, float, float] | None = None) -> Nuisance:
    """Estimate the prior of the nuisance parameters in the next frame from contact-free frames.

    The nuisance parameters are pose steps, softness and pulls (c in all), which are common to all frames, and the error fields of v cameras and of the
    model, each with p centres, of which a share is common to all frames and the rest is drawn independently for each frame.

    Arguments:
        nuisance: the prior before these frames.
        grams: inner products of the residual rows of each contact-free frame, results of `gram_of`.
        sizes: standard deviation of the cameras' error fields [m]; that of the model's error field relative to the displacement [1]; share of their variance
            that is common to all frames, 0 … 1. Default: the values on a grid that maximise the evidence (marginal likelihood) of the frames.

    Returns:
        `nuisance` with the mean, shape (c + (v + 1) p,), and the root of the covariance of this prior, and with the sizes that were used.
    """
    if sizes is None:
        grid = ((b, m, a) for b in BIAS_M for m in MODEL_SHARE for a in (0.0, 0.8))
        best = min(grid, key=lambda s: _evidence(nuisance, grams, s))
        sizes = min(((*best[:2], a) for a in COMMON), key=lambda s: _evidence(nuisance, grams, s))
    own, mean, root, inner, right = _normal_equations(nuisance, grams, sizes)[:5]
    covariance = root @ np.linalg.solve(inner, root.T) + np.diag(np.append(np.zeros(nuisance.common), own**2))
    return replace(
        nuisance, mean=freeze(mean + root @ np.linalg.solve(inner, right)), root=freeze(root_of(covariance)), sizes=sizes
    )


def without_poses(gram: FloatArray, pose_steps: int, common: int) -> FloatArray:
    """Make the error fields of a frame orthogonal to the camera poses, in the inner products of its residual rows.

    A smooth error field and a shift of the camera change the residual alike. With fields orthogonal to the poses, all that a pose can fit is
    attributed to the pose (restricted spatial regression, Reich, Hodges & Zadnik 2006).

    Arguments:
        gram: inner products of the parameters' columns and the residual, result of `gram_of`, shape (k + 1, k + 1) with k nuisance parameters.
        pose_steps: number of pose parameters, the first columns: six per camera (three rotations, three translations).
        common: number of parameters before the error fields: pose steps, softness and pulls.

    Returns:
        the inner products with the changed columns of the fields, of the same shape.
    """
    pose, field = slice(0, pose_steps), slice(common, len(gram) - 1)
    change = np.eye(len(gram))
    change[pose, field] = -np.linalg.lstsq(gram[pose, pose], gram[pose, field], rcond=1e-10)[0]
    return np.asarray(change.T @ gram @ change)


def root_of(covariance: FloatArray) -> FloatArray:
    """Return a square root R of a covariance R Rᵀ, of the same shape."""
    values, vectors = np.linalg.eigh(covariance) if covariance.size else (np.zeros(0), np.zeros((0, 0)))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _normal_equations(
    nuisance: Nuisance, grams: Sequence[FloatArray], sizes: tuple[float, float, float]
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, float, FloatArray]:
    """Return the sizes of each frame's own errors ((v + 1) p,), prior mean and root of (θ, e), and the normal equations of its whitened form: matrix
    and right-hand side; the log determinant of the marginalised errors; and the summed inner products."""
    c = nuisance.common
    spread = np.array(sizes[:2])[nuisance.fields]
    own, shared = np.sqrt(1.0 - sizes[2]) * spread, np.sqrt(sizes[2]) * spread
    total, logdet = np.zeros_like(grams[0]), 0.0
    for gram in grams:
        side = own[:, None] * gram[c:-1]
        core = np.eye(len(spread)) + side[:, c:-1] * own
        total += gram - side.T @ np.linalg.solve(core, side)
        logdet += float(np.linalg.slogdet(core)[1])
    root = block_diag(root_of(nuisance.first_covariance), np.diag(shared))
    mean = np.append(nuisance.first_mean, np.zeros(len(spread)))
    inner = np.eye(root.shape[1]) + root.T @ total[:-1, :-1] @ root
    right = root.T @ (total[:-1, -1] - total[:-1, :-1] @ mean)
    return own, mean, root, inner, right, logdet, total


def _evidence(nuisance: Nuisance, grams: Sequence[FloatArray], sizes: tuple[float, float, float]) -> float:
    """Return −2 log evidence of the frames and of the sizes, up to a constant."""
    _, mean, _, inner, right, logdet, total = _normal_equations(nuisance, grams, sizes)
    left = total[-1, -1] - 2.0 * mean @ total[:-1, -1] + mean @ total[:-1, :-1] @ mean
    beforehand = float(((np.log(np.array(sizes[:2]) / EXPECTED) / np.log(SIZE_FACTOR)) ** 2).sum())
    return float(left - right @ np.linalg.solve(inner, right) + logdet + np.linalg.slogdet(inner)[1]) + beforehand
