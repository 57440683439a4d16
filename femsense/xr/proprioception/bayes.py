"""The paper's network: ten sigmoid units and a linear output, trained with Bayesian regularisation.

    F = β Σ |y − f(x)|² + α Σ w²,   γ = P − α tr (β JᵀJ + α I)⁻¹,   α = γ / (2 Σ w²),   β = (N − γ) / (2 Σ |y − f(x)|²)

minimised by Levenberg–Marquardt, with α and β re-estimated after each step: γ is the number of weights that the data determine.
Foresee and Hagan 1997, Gauss–Newton approximation to Bayesian learning; MacKay 1992. JᵀJ is built by blocks, without J.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.xr.proprioception.network import Network, Units, sigmoid

HIDDEN = 10
"""As in the paper."""
STEPS = 100
ENOUGH = 1e-4
"""Relative fall of F over ten steps below which training ends."""
DAMPING = 0.005
"""At the start, relative to the mean of the diagonal of JᵀJ."""


@dataclass(eq=False, slots=True)
class _Weights:
    """Weights with their biases in the last column."""

    hidden: FloatArray
    """shape (h, d + 1)."""
    out: FloatArray
    """shape (o, h + 1)."""

    @property
    def flat(self) -> FloatArray:
        return np.concatenate([self.hidden.ravel(), self.out.ravel()])

    def moved(self, step: FloatArray) -> _Weights:
        first = self.hidden.size
        return _Weights(self.hidden + step[:first].reshape(self.hidden.shape), self.out + step[first:].reshape(self.out.shape))


def train_bayesian(x: FloatArray, y: FloatArray, *, seed: int, steps: int = STEPS) -> Network:
    """Return the paper's network.

    Arguments:
        x: inputs, shape (n, d).
        y: outputs, shape (n, o).
        seed: of the weights at the start.
        steps: Levenberg–Marquardt steps at most.
    """
    centre, scale = x.mean(axis=0), inverse_spread(x)
    middle, size = y.mean(axis=0), 1.0 / float(inverse_spread(y.ravel()[:, None])[0])
    z = np.hstack([(x - centre) * scale, np.ones((len(x), 1))])
    weights = _minimise(z, (y - middle) / size, _start(z, y.shape[1], np.random.default_rng(seed)), steps)
    A, d = size * weights.out[:, :-1], middle + size * weights.out[:, -1]
    return Network(
        Units.SIGMOID, centre, scale, weights.hidden[:, :-1], weights.hidden[:, -1], A, np.zeros((len(d), x.shape[1])), d
    )


def _minimise(z: FloatArray, t: FloatArray, weights: _Weights, steps: int) -> _Weights:
    alpha, beta = 0.01, 1.0
    errors, H = _forward(z, t, weights)
    damping, history = DAMPING, [np.inf]
    for _ in range(steps):
        G, slope = _normal_equations(z, errors, H, weights)
        cost = beta * (errors**2).sum() + alpha * (weights.flat**2).sum()
        gradient = beta * slope + alpha * weights.flat
        while damping < 1e10:
            system = beta * G + (alpha + damping * beta * np.trace(G) / len(G)) * np.eye(len(G))
            trial = weights.moved(-np.linalg.solve(system, gradient))
            trial_errors, trial_H = _forward(z, t, trial)
            if beta * (trial_errors**2).sum() + alpha * (trial.flat**2).sum() < cost:
                break
            damping *= 10.0
        else:
            return weights
        weights, errors, H, damping = trial, trial_errors, trial_H, max(0.1 * damping, 1e-12)
        alpha, beta = _evidence(G, alpha, beta, weights, errors)
        history.append((errors**2).mean() + alpha / beta * (weights.flat**2).sum() / errors.size)
        if len(history) > 12 and history[-11] - history[-1] < ENOUGH * history[-1]:
            break
    return weights


def _evidence(G: FloatArray, alpha: float, beta: float, weights: _Weights, errors: FloatArray) -> tuple[float, float]:
    """Return α and β after a step."""
    spectrum = np.maximum(np.linalg.eigvalsh(G), 0.0)
    gamma = float((beta * spectrum / (beta * spectrum + alpha)).sum())
    square = max(float((errors**2).sum()), 1e-12 * errors.size)
    return gamma / (2.0 * float((weights.flat**2).sum())), max(errors.size - gamma, 1.0) / (2.0 * square)


def _forward(z: FloatArray, t: FloatArray, weights: _Weights) -> tuple[FloatArray, FloatArray]:
    """Return errors f(x) − y, shape (n, o), and hidden units with a one, shape (n, h + 1)."""
    H = np.hstack([sigmoid(z @ weights.hidden.T), np.ones((len(z), 1))])
    return H @ weights.out.T - t, H


def _normal_equations(z: FloatArray, errors: FloatArray, H: FloatArray, weights: _Weights) -> tuple[FloatArray, FloatArray]:
    """Return JᵀJ, shape (P, P), and Jᵀ errors, shape (P,)."""
    S = H[:, :-1]
    D = S * (1.0 - S)
    units, inputs, outputs = D.shape[1], z.shape[1], errors.shape[1]
    out = weights.out[:, :-1]
    first = units * inputs
    G = np.zeros((first + outputs * (units + 1),) * 2)
    Dz = (D[:, :, None] * z[:, None, :]).reshape(len(z), first)
    G[:first, :first] = (Dz.T @ Dz) * np.kron(out.T @ out, np.ones((inputs, inputs)))
    cross = (Dz.T @ H).reshape(units, inputs, units + 1)
    G[:first, first:] = np.einsum("oi,ijk->ijok", out, cross).reshape(first, -1)
    G[first:, :first] = G[:first, first:].T
    G[first:, first:] = np.kron(np.eye(outputs), H.T @ H)
    slope = np.concatenate([(((errors @ out) * D).T @ z).ravel(), (errors.T @ H).ravel()])
    return G, slope


def _start(z: FloatArray, outputs: int, rng: np.random.Generator) -> _Weights:
    """Return weights that spread the units over the inputs (Nguyen and Widrow 1990)."""
    inputs = z.shape[1] - 1
    W = rng.standard_normal((HIDDEN, inputs))
    W *= 1.4 * HIDDEN ** (1.0 / inputs) / np.linalg.norm(W, axis=1, keepdims=True)
    places = z[rng.integers(len(z), size=HIDDEN), :-1]
    W = np.hstack([W, -(W * places).sum(axis=1, keepdims=True)])
    return _Weights(W, 0.1 * rng.standard_normal((outputs, HIDDEN + 1)))


def inverse_spread(x: FloatArray) -> FloatArray:
    """Return one over the standard deviation of each column; 0 for a column that never changes."""
    std = x.std(axis=0)
    return np.asarray(np.where(std > 1e-12 * (1.0 + np.abs(x).max(axis=0)), 1.0 / np.where(std > 0, std, 1.0), 0.0))
