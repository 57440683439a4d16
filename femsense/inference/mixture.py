"""The noise of a row: a mixture of the robot (Gaussian) and of other objects (uniform), with its responsibilities.

    −2 log[ exp(−z²/2κ²) + o ],   z = r/σ,   o = ω √(2π) σ / size

ω: odds that a pixel shows another object on its side of the surface, in front or behind, rather than the robot; size: length over which
that object may lie. κ ≥ 1 widens the noise while a fit is far from its optimum (graduated non-convexity, Blake & Zisserman 1987).
Source of the mixture: Verbeek, Vlassis & Kröse 2003 for EM; Aitkin & Wilson 1980 for outliers as a mixture component.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from femsense.core.arrays import BoolArray, FloatArray


def misfit(z: FloatArray, log_other: FloatArray, share: FloatArray, kappa: FloatArray | float = 1.0) -> tuple[float, FloatArray]:
    """Return Σ share · −2 log[…] of whitened residuals (r,) and the responsibilities of the robot, shape (r,)."""
    weight = np.empty_like(z)
    return float(_misfit(z / kappa, log_other, share, weight)), weight


@njit(cache=True)
def _misfit(z, log_other, share, weight):  # type: ignore[no-untyped-def]
    total = 0.0
    for j in range(len(z)):
        a, b = -0.5 * z[j] ** 2, log_other[j]
        top = max(a, b)
        log_sum = top + np.log(np.exp(a - top) + np.exp(b - top))
        total -= 2.0 * share[j] * log_sum
        weight[j] = np.exp(a - log_sum)
    return total


@dataclass(frozen=True, slots=True)
class Others:
    """Odds ω that a pixel shows another object rather than the robot."""

    front: float
    """In front of the surface."""
    behind: float
    """Behind it: the robot is opaque, but pixels at depth edges mix both sides."""

    def log_odds(self, std: FloatArray, length: float, behind: BoolArray) -> FloatArray:
        """Return log o of pixels, shape (r,).

        Arguments:
            std: σ along the ray [m], shape (r,).
            length: over which another object may lie [m].
            behind: whether a pixel lies behind the surface that its ray meets, shape (r,).
        """
        return np.asarray(np.log(np.where(behind, self.behind, self.front) * np.sqrt(2.0 * np.pi) * std / length))


@dataclass(frozen=True, slots=True)
class Width:
    """Factors κ on the standard deviations of the rows [1], one for pixels and one for all others: large at the start of a fit, then reduced to 1."""

    pixels: float = 1.0
    others: float = 1.0

    def of(self, pixel: BoolArray) -> FloatArray:
        """Return κ of rows, of which some are pixels, shape (r,)."""
        return np.where(pixel, self.pixels, self.others)

    @property
    def narrow(self) -> bool:
        """Whether κ = 1."""
        return self.pixels == 1.0 and self.others == 1.0

    def narrowed(self, least: Width | None = None) -> Width:
        """Return the next widths: a third, but at least `least`, the scatter of the residual."""
        least = least or Width()
        third = [kappa / 3.0 if kappa > 1.5 else 1.0 for kappa in (self.pixels, self.others)]
        return Width(
            *(max(1.0, t, min(k, m)) for t, k, m in zip(third, (self.pixels, self.others), (least.pixels, least.others)))
        )


def first_width(z: FloatArray, pixel: BoolArray, coloured: bool, most: float) -> Width:
    """Return κ at the start of a fit: nine in ten pixels lie within 1.65 κ, and nine in ten of the other rows, or all where they are few.

    Arguments:
        z: whitened residuals, shape (r,).
        pixel: which rows are pixels, shape (r,).
        coloured: whether colour separates the robot; else κ of pixels is at most `most`.
    """
    kappa = np.abs(z) / 1.65
    common = float(np.quantile(kappa[pixel], 0.9)) if pixel.any() else 1.0
    common = common if coloured else min(common, most)
    rest = kappa[~pixel]
    others = float(np.quantile(rest, 0.9, method="higher")) if pixel.any() and len(rest) else 1.0
    return Width(*(value if value > 1.5 else 1.0 for value in (common, others)))
