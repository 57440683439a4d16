"""Equilibria of a `Solid` with cables: Newton with load steps, held and pulled cables, and certificates."""

from __future__ import annotations

import numpy as np

from .solid import Array, Cable, Diverged, Factor, Load, Solid, State

TOLERANCE_N = 1e-7


class Problem:
    """A body with its cables."""

    def __init__(self, solid: Solid, cables: list[Cable]) -> None:
        self.solid, self.cables = solid, cables
        self._last: Factor | None = None
        self.start_length = np.array([c.length(solid.rest) for c in cables])

    def nothing(self) -> Load:
        """No load at all."""
        c = len(self.cables)
        return Load(0.0, np.zeros(c), np.zeros(c), np.zeros(c, bool), np.zeros_like(self.solid.rest))

    def at_rest(self) -> State:
        """The unloaded body."""
        return State(self.solid.rest.copy(), np.zeros(len(self.cables)), self.nothing(), 0.0, 0)

    def shortening(self, x: Array) -> Array:
        """By how much each cable is shorter than at rest [m], (c,)."""
        return self.start_length - np.array([c.length(x) for c in self.cables])

    def unbalance(self, x: Array, tension: Array, load: Load) -> Array:
        """Sum of the forces on the nodes [N], (n, 3), zero at the clamp."""
        total = load.gravity * self.solid.pull_down + load.force - self.solid.inner_forces(x)
        for pull, cable in zip(tension, self.cables):
            total = total - pull * cable.gradient(x)
        total[self.solid.clamped] = 0.0
        return total

    def factor(self, x: Array, tension: Array) -> Factor:
        """The factorised tangent at a state."""
        free = np.flatnonzero(self.solid.free)
        tangent = self.solid.stiffness(x)
        for pull, cable in zip(tension, self.cables):
            if pull > 0:
                tangent = tangent + pull * cable.hessian(x)[free][:, free]
        return Factor(tangent.tocsr())

    def solve(self, load: Load, start: State) -> State:
        """The equilibrium under a load, in as many steps from the start as it takes."""
        state, share, step = start, 0.0, 1.0
        tries = 0
        while share < 1.0:
            goal = min(1.0, share + step)
            try:
                state = self._newton(_between(start.load, load, goal, state), state)
                share = goal
            except Diverged:
                step /= 2
                tries += 1
                if tries > 7:
                    raise
        slack = load.held & (state.tension < -1e-6)
        if slack.any():
            loose = Load(load.gravity, np.where(slack, 0.0, load.tension), load.shortening, load.held & ~slack, load.force)
            return self.solve(loose, state)
        return state

    def _newton(self, load: Load, start: State) -> State:
        x, tension = start.x.copy(), np.where(load.held, start.tension, load.tension)
        held = np.flatnonzero(load.held)
        before, factor = np.inf, self._last
        for iteration in range(60):
            left = self.unbalance(x, tension, load)
            gap = self.shortening(x)[held] - load.shortening[held]
            size = float(np.abs(left).max()) + float(np.abs(gap).max(initial=0.0)) * 100
            if size < TOLERANCE_N:
                return State(x, tension, load, float(np.abs(left).max()), iteration)
            if iteration > 4 and not size < 1e3:
                break
            if factor is None or size > 0.3 * before:
                factor = self._last = self.factor(x, tension)
            before = size
            move, change = self._step(x, left, gap, held, factor)
            move *= min(1.0, 0.012 / max(1e-12, float(np.abs(move).max())))
            x = self._safe(x, move)
            tension = tension.copy()
            tension[held] += change
        raise Diverged("Newton ended without an equilibrium")

    def _step(self, x: Array, left: Array, gap: Array, held: Array, factor: Factor) -> tuple[Array, Array]:
        free = self.solid.free
        right = [left.ravel()[free]]
        right += [self.cables[k].gradient(x).ravel()[free] for k in held]
        stack = np.column_stack(right)
        soft = factor(stack).reshape(stack.shape)
        move = soft[:, 0]
        change = np.zeros(0)
        if len(held):
            # gap = shortening - wanted; the shortening falls by H dx, and a tension more moves the nodes by -K^-1 H^T.
            change = np.linalg.solve(stack[:, 1:].T @ soft[:, 1:], stack[:, 1:].T @ move - gap)
            move = move - soft[:, 1:] @ change
        wide = np.zeros(x.size)
        wide[free] = move
        return wide.reshape(x.shape), change

    def _safe(self, x: Array, move: Array) -> Array:
        for k in range(6):
            try:
                self.solid._gradient(x + move / 2**k)
            except Diverged:
                continue
            return x + move / 2**k
        raise Diverged("no step keeps the elements whole")

    def yielding(self, state: State, right: Array) -> Array:
        """Motion of the nodes by unit loads [m/N]: right (n, 3, k) gives (n, 3, k); held cables keep their length."""
        free = self.solid.free
        held = np.flatnonzero(state.load.held)
        stack = right.reshape(-1, right.shape[2])[free]
        ties = (
            np.column_stack([self.cables[k].gradient(state.x).ravel()[free] for k in held])
            if len(held)
            else np.zeros((len(stack), 0))
        )
        factor = self._last = self.factor(state.x, state.tension)
        soft = factor(np.hstack([stack, ties])).reshape(len(stack), -1)
        out = soft[:, : stack.shape[1]]
        if len(held):
            tied = soft[:, stack.shape[1] :]
            out = out - tied @ np.linalg.solve(ties.T @ tied, ties.T @ out)
        wide = np.zeros((state.x.size, right.shape[2]))
        wide[free] = out
        return wide.reshape(*state.x.shape, right.shape[2])

    def potential(self, x: Array, state: State) -> float:
        """Energy of body, weight, forces and cables at the tensions of a state [J]."""
        work = float(np.sum((state.load.gravity * self.solid.pull_down + state.load.force) * (x - self.solid.rest)))
        cables = sum(pull * cable.length(x) for pull, cable in zip(state.tension, self.cables))
        return self.solid.strain_energy(x) - work + cables

    def certificate(self, state: State, rng: np.random.Generator) -> dict[str, float]:
        """Residual, slope (0) and curvature (> 0 where stable) of the potential along a smooth direction."""
        wave = rng.normal(size=(3, 3)) / np.ptp(self.solid.rest, axis=0).max()
        direction = np.sin(self.solid.rest @ wave.T) * (~self.solid.clamped)[:, None]
        step = 1e-4 / np.abs(direction).max()
        low, mid, high = (self.potential(state.x + k * step * direction, state) for k in (-1, 0, 1))
        curvature = high - 2 * mid + low
        return {
            "residual_n": state.residual_n,
            "energy_slope": (high - low) / 2 / max(abs(curvature), 1e-30),
            "energy_curvature_j": curvature,
        }


def _between(a: Load, b: Load, share: float, state: State) -> Load:
    now = np.where(b.held & ~a.held, b.shortening, a.shortening)
    pulls = np.where(a.held, state.tension, a.tension)
    mixed = [
        u + share * (v - u) for u, v in ((a.gravity, b.gravity), (pulls, b.tension), (now, b.shortening), (a.force, b.force))
    ]
    return Load(float(mixed[0]), mixed[1], mixed[2], b.held, mixed[3])
