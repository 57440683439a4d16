"""A robot that does what it is told: it listens to commands, stops when they stop, and takes the equilibrium of its inputs."""

from __future__ import annotations

import json
import time

import numpy as np

import femsense as fs
from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.payloads import COMMAND, INPUTS, Input, inputs_bytes, topic


class ObedientRobot:
    """A sink of a hub that keeps the inputs that were commanded, and says what they are."""

    def __init__(self, hub: Hub, robot: fs.Robot, name: str, inputs: tuple[Input, ...]) -> None:
        self.hub, self.robot, self.name, self.kinds = hub, robot, name, inputs
        self.inputs = {one.name: one.low for one in inputs}
        self.heard: list[tuple[float, dict[str, float]]] = []
        self.armed = False
        hub.attach(self)

    def send(self, messages: tuple[Message, ...]) -> None:
        for message in messages:
            if message.topic == topic(self.name, COMMAND):
                self.obey(json.loads(message.payload))

    def obey(self, told: dict[str, object]) -> None:
        self.armed = told["armed"] is True
        if self.armed:
            self.inputs = {row["name"]: row["value"] for row in told["inputs"]}  # type: ignore[attr-defined, index, union-attr]
            self.heard.append((time.monotonic(), dict(self.inputs)))
        values = [self.inputs[one.name] for one in self.kinds]
        self.hub.publish([Message(topic(self.name, INPUTS), inputs_bytes(0, 0.0, self.kinds, values))])

    def place(self, marker: int) -> np.ndarray:
        """Where a marker rests under the inputs [m]."""
        state = fs.solve_equilibrium(self.robot.body, tension=self.inputs)
        return self.robot.markers.positions(state.positions)[marker]

    def close(self) -> None:
        pass
