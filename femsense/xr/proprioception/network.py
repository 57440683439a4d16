"""One layer of hidden units with a parallel linear path: the form of all maps that are learnt here.

y = A φ(z) + C z + d,   z = scale · (x − centre)
φ_j = 1 / (1 + exp(−(B z + b)_j))   "sigmoid"      φ_j = exp(−½ |z − B_j|²)   "radial"      no φ   "linear"
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from femsense.core.arrays import BoolArray, FloatArray


class Units(StrEnum):
    """The hidden units of a network."""

    LINEAR = "linear"
    """None."""
    SIGMOID = "sigmoid"
    RELU = "relu"
    RADIAL = "radial"


@dataclass(frozen=True, eq=False, slots=True)
class Network:
    """A map from inputs, shape (n, d), to outputs, shape (n, o)."""

    units: Units
    centre: FloatArray
    """shape (d,), in the units of the inputs."""
    scale: FloatArray
    """shape (d,), one over those units."""
    B: FloatArray
    """Weights of the hidden units, or their centres, shape (h, d); h = 0 if there are none."""
    b: FloatArray
    """shape (h,)."""
    A: FloatArray
    """shape (o, h)."""
    C: FloatArray
    """shape (o, d)."""
    d: FloatArray
    """shape (o,)."""

    def __call__(self, x: FloatArray) -> FloatArray:
        """Return the outputs, shape (n, o), of inputs, shape (n, d)."""
        z = self.normalised(x)
        return np.asarray(self.hidden(z) @ self.A.T + z @ self.C.T + self.d)

    def normalised(self, x: FloatArray) -> FloatArray:
        """Return the inputs without their units, shape (n, d)."""
        return np.asarray((x - self.centre) * self.scale)

    def hidden(self, z: FloatArray) -> FloatArray:
        """Return the hidden units of normalised inputs, shape (n, h)."""
        if self.units == Units.RADIAL:
            return np.asarray(np.exp(-0.5 * squared_distances(z, self.B)))
        a = z @ self.B.T + self.b
        return np.maximum(a, 0.0) if self.units == Units.RELU else sigmoid(a)

    @property
    def uses(self) -> BoolArray:
        """Which inputs the output depends on, shape (d,): constant inputs have no scale, excluded ones no weight."""
        hidden = np.ones(len(self.scale), dtype=bool) if self.units == Units.RADIAL else (self.B != 0).any(axis=0)
        return np.asarray((self.scale != 0) & ((self.C != 0).any(axis=0) | (hidden & bool(self.A.any()))))

    def followed_by(self, M: FloatArray, shift: FloatArray) -> Network:
        """Return the network whose outputs are M y + shift, M of shape (o, o)."""
        return replace(self, A=M @ self.A, C=M @ self.C, d=M @ self.d + shift)

    def with_linear(self, C: FloatArray, d: FloatArray) -> Network:
        """Return the network with a linear map of the normalised inputs added, C of shape (o, d), d of shape (o,)."""
        return replace(self, C=self.C + C, d=self.d + d)


def linear_network(centre: FloatArray, scale: FloatArray, C: FloatArray, d: FloatArray) -> Network:
    """Return a network without hidden units."""
    return Network(Units.LINEAR, centre, scale, np.zeros((0, C.shape[1])), np.zeros(0), np.zeros((len(C), 0)), C, d)


def sigmoid(x: FloatArray) -> FloatArray:
    """Return 1 / (1 + exp(−x)) without overflow."""
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * x)))


def squared_distances(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return |x_i − y_j|², shape (n, k), of points (n, d) and (k, d)."""
    return np.asarray(np.maximum(0.0, (x**2).sum(axis=1)[:, None] + (y**2).sum(axis=1) - 2.0 * x @ y.T))
