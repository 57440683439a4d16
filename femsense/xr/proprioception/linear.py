"""The baselines: ridge regression, and a Gaussian process in the form of radial units with a linear map.

ridge:   C = argmin Σ |y − C z − d|² + λ n |C|²
radial:  the residual of ridge, by k(z, z') = exp(−½ |z − z'|² / ℓ²) on at most `CENTRES` rows (subset of regressors;
         Rasmussen and Williams 2006, section 8.3): A = Rᵀ Φ (ΦᵀΦ + ν K)⁻¹
"""

from __future__ import annotations

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.xr.proprioception.bayes import inverse_spread
from femsense.xr.proprioception.network import Network, Units, linear_network

CENTRES = 200
JITTER = 1e-9


def train_ridge(x: FloatArray, y: FloatArray, *, penalty: float) -> Network:
    """Return a linear map of inputs (n, d) to outputs (n, o), `penalty` λ relative to the variance of an input."""
    centre, scale = x.mean(axis=0), inverse_spread(x)
    z, middle = (x - centre) * scale, y.mean(axis=0)
    C = np.linalg.solve(z.T @ z + (penalty + JITTER) * len(z) * np.eye(z.shape[1]), z.T @ (y - middle)).T
    return linear_network(centre, scale, C, middle)


def train_radial(x: FloatArray, y: FloatArray, *, penalty: float, length: float, noise: float) -> Network:
    """Return a Gaussian process mean around a linear map.

    Arguments:
        x, y: inputs (n, d) and outputs (n, o).
        penalty: ridge penalty of the linear map, as for `train_ridge`.
        length: ℓ, in spreads of the inputs times √d.
        noise: variance ν of the unexplained part, relative to the explained one.
    """
    line = train_ridge(x, y, penalty=penalty)
    used = max(int((line.scale > 0).sum()), 1)
    narrow = 1.0 / (length * float(np.sqrt(used)))
    z = np.asarray(line.normalised(x) * narrow)
    centres = np.asarray(z[:: -(-len(z) // CENTRES)])
    net = Network(
        Units.RADIAL,
        line.centre,
        np.asarray(line.scale * narrow),
        centres,
        np.zeros(len(centres)),
        np.zeros((y.shape[1], len(centres))),
        np.asarray(line.C / narrow),
        line.d,
    )
    phi, K = net.hidden(z), net.hidden(centres)
    system = phi.T @ phi + noise * K + JITTER * len(z) * np.eye(len(K))
    A = np.asarray(np.linalg.solve(system, phi.T @ (y - line(x))).T, dtype=np.float64)
    return Network(Units.RADIAL, net.centre, net.scale, centres, net.b, A, net.C, net.d)
