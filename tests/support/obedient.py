"""A robot that does what it is told: it listens to commands, stops when they stop, and takes the equilibrium of its inputs."""

from __future__ import annotations

import json
import time

import numpy as np

import femsense as fs
from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.payloads import Input, Kind, inputs_bytes, measured_bytes, topic


class ObedientRobot:
    """A sink of a hub that keeps the inputs that were commanded, and says what they are."""

    def __init__(
        self, hub: Hub, robot: fs.Robot, name: str, inputs: tuple[Input, ...], *, post: tuple[np.ndarray, float] | None = None
    ) -> None:
        """post: a place on the body, and the height above which it cannot rise there [m]."""
        place, self.post_m = (np.zeros(3), None) if post is None else post
        self._under = int(((robot.body.mesh.nodes - place) ** 2).sum(axis=1).argmin())
        self._last: fs.Equilibrium | None = None
        self._rng = np.random.default_rng(0)
        self.pushed_n = 0.0
        self.hub, self.robot, self.name, self.kinds = hub, robot, name, inputs
        self.inputs = {one.name: one.low for one in inputs}
        self.heard: list[tuple[float, dict[str, float]]] = []
        self.armed = False
        hub.attach(self)

    def send(self, messages: tuple[Message, ...]) -> None:
        for message in messages:
            if message.topic == topic(self.name, Kind.COMMAND):
                self.obey(json.loads(message.payload))

    def obey(self, told: dict[str, object]) -> None:
        self.armed = told["armed"] is True
        if self.armed:
            self.inputs = {row["name"]: row["value"] for row in told["inputs"]}  # type: ignore[attr-defined, index, union-attr]
            self.heard.append((time.monotonic(), dict(self.inputs)))
        values = [self.inputs[one.name] for one in self.kinds]
        self.hub.publish([Message(topic(self.name, Kind.INPUTS), inputs_bytes(0, 0.0, self.kinds, values))])

    def place(self, marker: int) -> np.ndarray:
        """Where a marker rests under the inputs [m]."""
        return np.asarray(self.robot.markers.positions(self.state().positions)[marker])

    def report(self, names: tuple[str, ...]) -> None:
        """Say where the markers are, as motion capture would: to a tenth of a millimetre."""
        state = self.state()
        places = self.robot.markers.positions(state.positions) + 1e-4 * self._rng.normal(size=(len(names), 3))
        self.hub.received(Message(topic(self.name, Kind.MEASURED), measured_bytes(0, 0.0, dict(zip(names, places)))), "capture")

    def state(self) -> fs.Equilibrium:
        """The equilibrium under the inputs; where there is a post, no node of the body's top rises above it."""
        free = self._solved(0.0)
        if self.post_m is None or free.positions[self._under, 2] <= self.post_m:
            self.pushed_n = 0.0
            return free
        force, step = 0.0, 0.2  # secant on the force that keeps the node at the post
        gap, state = float(free.positions[self._under, 2]) - self.post_m, free
        for _ in range(12):
            state = self._solved(force + step)
            now = float(state.positions[self._under, 2]) - self.post_m
            force, step, gap = force + step, -now * step / (now - gap), now
            if abs(now) < 1e-6:
                break
        self.pushed_n = force
        return state

    def _solved(self, force: float) -> fs.Equilibrium:
        forces = np.zeros_like(self.robot.body.mesh.nodes)
        forces[self._under, 2] = -force
        self._last = fs.solve_equilibrium(self.robot.body, tension=self.inputs, nodal_forces=forces, start=self._last)
        return self._last

    def close(self) -> None:
        pass
