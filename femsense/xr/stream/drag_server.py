"""Replies to a dragged point: inputs by a `Follower`, the shape that the robot can reach, and commands while armed and held.

One client controls the robot at a time (`lease`), and every client can stop it. Each request is answered with the state of the search;
while the request is unchanged, replies continue until the search ends.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from threading import Event, Lock, Thread
from typing import Any

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.control.follow import Follower
from femsense.control.motion import CONVERGING, REACHED, STOPPED, Motion
from femsense.control.search import ReachOptions
from femsense.core.arrays import FloatArray, diagonal
from femsense.fem.mesh import embed_points
from femsense.model.robot import Robot
from femsense.xr.skinning import Skin, prepare_poses
from femsense.xr.stream.command_gate import CommandGate, GateOptions
from femsense.xr.stream.drag_messages import Wish, in_plain_words, is_number, place_of, read_wish, rows_of
from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.lease import Lease, Ruling
from femsense.xr.stream.payloads import (
    COMMAND,
    DRAG,
    GHOST,
    INPUTS,
    LEASE,
    MEASURED,
    REACH,
    STOP,
    Handle,
    Input,
    bone_rows,
    header,
    pose_bytes,
    read_document,
    split_topic,
    topic,
)
from femsense.xr.stream.tip_feedback import FeedbackOptions, TipFeedback

LARGEST_RANGE = {"N": 5.0, "m": 0.05, "Pa": 50e3}
"""Of an input for which the robot declares no limit."""
BEGINS = "; the inputs of the robot are unknown: the first command starts from the displayed ones"
FAR = 2.0
"""A wish farther from the body than this many times its size is no wish."""


@dataclass(frozen=True, slots=True)
class DragOptions:
    """Options of the drag server: how it answers requests to move a point of the robot."""

    gate: GateOptions = field(default_factory=GateOptions)
    tolerance_m: float = 1e-4
    """A target is reached that is missed by less [m]: finer than a hand drags."""
    answer_s: float = 0.02
    """Time after which no further equilibrium is started for a reply [s]; the next reply continues there."""
    rest_s: float = 0.3
    """Time after which an unchanged target counts as resting [s]; it is then also searched from rest if it is not reached."""
    feedback: FeedbackOptions = field(default_factory=FeedbackOptions)
    """Correction of the inputs by measurements."""


def drive_inputs(robot: Robot) -> tuple[Input, ...]:
    """Return the inputs of a robot with their limits: tensions [N] of cables, pressures [Pa] of chambers."""
    body = robot.body
    cables = [Input(c.name, "N", c.min_tension, _top(c.max_tension, "N")) for c in body.cables]
    return (*cables, *(Input(c.name, "Pa", 0.0, _top(c.max_pressure, "Pa")) for c in body.chambers))


def handles_of(robot: Robot) -> tuple[Handle, ...]:
    """Return the markers of a robot as points that may be dragged."""
    return tuple(Handle(name, point) for name, point in zip(robot.glued_names, robot.marker_points))


class DragServer:
    """Receives requests to move a point of one robot from a hub, and answers the newest one."""

    def __init__(
        self,
        hub: Hub,
        robot: Robot,
        skin: Skin,
        *,
        name: str | None = None,
        calibration: Calibration | None = None,
        options: DragOptions | None = None,
    ) -> None:
        """Start to reply.

        Arguments:
            hub: source of requests and destination of replies.
            robot: its limits hold.
            skin: its bones show the reachable shape; its vertices at rest are points of the robot.
            name: of the robot in topics.
            calibration: its initial inputs are subtracted from the commands.
            options: of replies and commands.
        """
        self.hub, self.robot, self.options = hub, robot, options or DragOptions()
        self.name = name or robot.name
        self.gate = CommandGate(drive_inputs(robot), self.options.gate)
        self._follower = Follower(
            robot,
            limits={one.name: (one.low, one.high) for one in self.gate.inputs},
            calibration=calibration,
            options=ReachOptions(tolerance_m=self.options.tolerance_m),
        )
        self._skin, self._fit = embed_points(robot.body.mesh, skin.rest), prepare_poses(skin)
        self._size = diagonal(robot.body.mesh.nodes)
        self._bones: FloatArray | None = None
        self._motion: Motion | None = None
        self._wish: Wish | None = None
        self._grabbed = False  # whether a point was grabbed since the last answer
        self._wanted: tuple[str, tuple[float, float, float]] | None = None
        self._still_since = 0.0
        self.lease = Lease(self.options.gate.hold_s)
        self._told: dict[str, float] = {}  # inputs reported by the robot
        self._told_at = float("-inf")
        self.feedback = TipFeedback(self._size, self.options.feedback)
        self._handle = ""
        self._settled_since: float | None = None
        self._measured_at: dict[str, float] = {}  # marker → when it was measured last
        self._unmeasured, self._unmeasured_at = "", float("-inf")  # reason why the robot is not measured, and its time
        self._answer: tuple[FloatArray, dict[str, Any]] | None = None
        self._fresh, self._stop, self._lock, self._telling = Event(), Event(), Lock(), Lock()
        self._seq = self._commands = self._leases = 0
        hub.listen(self._hear)
        self._threads = [Thread(target=run, daemon=True, name="femsense-drag") for run in (self._answer_all, self._command_all)]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stop; commands end."""
        self._stop.set()
        self._fresh.set()
        for thread in self._threads:
            thread.join(2.0)

    # ---- wishes

    def _hear(self, message: Message, who: str) -> None:
        known = split_topic(message.topic)
        if known is None or topic(known[0], DRAG) != topic(self.name, DRAG):
            return
        if known[1] == MEASURED:
            self._measure(message.payload)
        elif known[1] == DRAG:
            self._take(message, who)
        elif known[1] == STOP:
            self.stop()

    def _measure(self, payload: bytes) -> None:
        """Store the measured position of the dragged marker, and the inputs that the robot reports."""
        told, now = read_document(payload) or {}, time.monotonic()
        places = {str(row.get("name")): place_of(row.get("position_m")) for row in rows_of(told, "markers")}
        inputs = self._values(told)
        with self._lock:
            place = places.get(self._handle)
            self._measured_at.update((name, now) for name, there in places.items() if there is not None)
            if why := str(told.get("detail", "")):
                self._unmeasured, self._unmeasured_at = why, now
            if place is not None and self._is_near(place):
                self.feedback.measured(now, np.array(place))
            if inputs:
                self._told, self._told_at = inputs, now

    def stop(self) -> None:
        """Stop all motion immediately, for every client; motion requires disarming first."""
        with self._lock:
            self.lease.stop()
            self._let_go()
        if self.options.gate.allowed:
            self._stopped()
        self._say_who_steers()

    def _let_go(self) -> None:
        """Discard the current request."""
        self.gate.release()
        self.feedback.forget()
        self._wish, self._handle, self._grabbed = None, "", False

    def _take(self, message: Message, who: str) -> None:
        wish, now = read_wish(message.payload, who), time.monotonic()
        if wish is None or not self._can_be_meant(wish):
            return
        with self._lock:
            ruling = self.lease.rule(wish.claim, now)
            if ruling is Ruling.RELEASED:
                self._let_go()
            elif ruling in (Ruling.GRANTED, Ruling.RENEWED):
                if ruling is Ruling.GRANTED or wish.handle != self._handle:
                    self._let_go()
                    self._grabbed = True
                if ruling is Ruling.RENEWED:
                    self.gate.hold(now, armed=wish.claim.armed)
                self._wish, self._handle = wish, wish.handle
        if ruling is not Ruling.RENEWED:
            self._say_who_steers()
        self._fresh.set()

    def _say_who_steers(self) -> None:
        self._leases += 1
        document = {
            "header": header(self._leases, time.time(), "robot"),
            "client": self.lease.client,
            "number": self.lease.number,
            "expires_s": self.lease.hold_s,
            "stopped": self.lease.stopped,
        }
        self.hub.publish([Message(topic(self.name, LEASE), json.dumps(document).encode())])

    def _can_be_meant(self, wish: Wish) -> bool:
        """Return whether a wish is for a marker of the robot, and not far away from it."""
        if not wish.claim.held:
            return True
        return wish.handle in self.robot.glued_names and wish.target_m is not None and self._is_near(wish.target_m)

    def _is_near(self, place_m: tuple[float, float, float]) -> bool:
        middle = self.robot.body.mesh.nodes.mean(axis=0)
        return float(np.linalg.norm(np.subtract(place_m, middle))) <= FAR * self._size

    # ---- answers

    def _answer_all(self) -> None:
        while not self._stop.is_set():
            if self._wish is None or self._follower.resting:
                self._fresh.wait()
            elif self._follower.ended:
                self._fresh.wait(self.options.rest_s)  # the search then starts from rest
            self._fresh.clear()
            with self._lock:
                wish = self._wish
            if wish is not None and wish.target_m is not None and not self._stop.is_set():
                self.answer(wish.handle, wish.target_m)

    def answer(self, handle: str, target_m: tuple[float, float, float]) -> Motion:
        """Advance the search for a request, publish the result, and set it as the target of the gate.

        Measurements of the point while the robot is at rest correct the model's target (see `tip_feedback`).
        """
        begun = time.perf_counter()
        with self._lock:
            turn, grabbed, self._grabbed = self.gate.turn, self._grabbed, False
            moves = self.options.gate.allowed and self._wish is not None and self._wish.claim.armed
            current = {**self.gate.last, **self._current(time.monotonic())} if moves else self._shown()
            last = self._motion
            reached = None if last is None else last.reached_m.get(handle)
            arrived = last is not None and last.status == REACHED
            since = self._settled()
            wanted = self.feedback.target(
                time.monotonic(), np.array(target_m), settled_since=since, reached_m=reached, arrived=arrived
            )
        if grabbed and len(current) == len(self.gate.inputs):
            self._follower.begin(current)
        if (handle, target_m) != self._wanted:
            self._wanted, self._still_since = (handle, target_m), begun
        stays = begun - self._still_since >= self.options.rest_s
        motion = self._follower.step({handle: wanted}, seconds=self.options.answer_s, stays=stays)
        if motion.equilibrium.converged:
            self._motion = motion
            with self._lock:
                self.gate.want(motion.inputs, turn=turn)
        self._bones = self._fit(self._skin.positions(motion.positions), start=self._bones)
        off = float(np.linalg.norm(self.feedback.expected(motion.reached_m[handle]) - np.array(target_m)))
        asked = replace(motion, error_m=off)  # the search used the corrected target
        self._tell((self._bones, self._document(handle, asked, 1e3 * (time.perf_counter() - begun))))
        return motion

    def _tell(self, answer: tuple[FloatArray, dict[str, Any]] | None = None) -> None:
        """Publish an answer, or the newest once more, with whether commands go out now."""
        with self._telling:
            self._answer = answer or self._answer
            if self._answer is None:
                return
            self._seq += 1
            bones, document = self._answer
            document = {"header": header(self._seq, time.time(), "robot"), **document, "armed": self.gate.moving}
            ghost = pose_bytes(self._seq, time.time(), bone_rows(bones))
            found = json.dumps(document).encode()
            self.hub.publish([Message(topic(self.name, GHOST), ghost), Message(topic(self.name, REACH), found)])

    def _settled(self) -> float | None:
        """Return since when the commanded inputs are those of the newest answer, or None."""
        if self._motion is None or self._motion.status in (STOPPED, CONVERGING) or not self.gate.arrived:
            self._settled_since = None
        elif self._settled_since is None:
            self._settled_since = time.monotonic()
        return self._settled_since

    def _why_not_measured(self, handle: str, now: float) -> str:
        """Return in words why a point is not corrected at a time [s]; empty if it is measured, or was never measured."""
        fresh, ago = self.options.feedback.fresh_s, now - self._measured_at.get(handle, float("-inf"))
        if ago <= fresh or not (self._measured_at or self._unmeasured):
            return ""
        if now - self._unmeasured_at <= fresh:
            return f"; not measured: {self._unmeasured}"
        return f"; not measured: {f'nothing for {ago:.1f} s' if np.isfinite(ago) else f'no measured position of {handle} is'}"

    def _document(self, handle: str, motion: Motion, ms: float) -> dict[str, Any]:
        units = {one.name: one.unit for one in self.gate.inputs}
        missed = self.feedback.missed_m
        unknown = self._why_not_measured(handle, time.monotonic())
        measured = unknown if np.isnan(missed) else f"; measured {1e3 * missed:.1f} mm away from there"
        known = {} if np.isnan(missed) else {"measured_error_m": missed}
        begins = "" if self._is_known(time.monotonic()) else BEGINS
        return {
            "status": motion.status,
            "text": in_plain_words(motion) + measured + begins,
            "error_m": motion.error_m,
            **known,
            "correction_m": float(np.linalg.norm(self.feedback.correction_m)),
            "ms": ms,
            "inputs": [{"name": name, "unit": units[name], "value": value} for name, value in motion.inputs.items()],
        }

    # ---- commands

    def _command_all(self) -> None:
        """Send commands while the gate allows them; report once when it closes."""
        was_moving = False
        while not self._stop.wait(1.0 / self.options.gate.command_hz):
            with self._lock:
                inputs = self.gate.step(time.monotonic(), self._current(time.monotonic()))
                moving = self.gate.moving
                expired = self.lease.expire(time.monotonic())
            if expired:
                self._say_who_steers()
            if inputs is not None:
                self._command(inputs, armed=True)
            elif was_moving and not moving:
                self._stopped()
            was_moving = moving
        if was_moving:
            with self._lock:
                self.gate.release()
                self.gate.step(time.monotonic(), {})
            self._stopped()

    def _stopped(self) -> None:
        """Report the end of the commands: the inputs stay. The last reply, retained for new clients, is updated too."""
        self._command(self.gate.last, armed=False)
        self._tell()

    def _command(self, inputs: Mapping[str, float], *, armed: bool) -> None:
        units = {one.name: one.unit for one in self.gate.inputs}
        document = {
            "header": header(self._commands, time.time(), "robot"),
            "armed": armed,
            "expires_s": self.options.gate.hold_s,
            "inputs": [{"name": name, "unit": units[name], "value": value} for name, value in inputs.items()],
        }
        self._commands += 1
        self.hub.publish([Message(topic(self.name, COMMAND), json.dumps(document).encode())])

    def _current(self, now: float) -> dict[str, float]:
        """Return the robot's inputs at a time [s], as far as it reports them on `measured`.

        Before the first command the topic `inputs` is used too; after it this is not valid: a replayed run would report its recorded inputs.
        """
        told = self._told if now - self._told_at <= self.options.feedback.fresh_s else {}
        return told if self.gate.last else {**self._shown(), **told}

    def _is_known(self, now: float) -> bool:
        """Return whether the starting point of commands is known at a time [s]: reported by the robot, or its last command."""
        fresh = self._told if now - self._told_at <= self.options.feedback.fresh_s else {}
        return bool(self.gate.last) or len(fresh) == len(self.gate.inputs) or not self.options.gate.allowed

    def _shown(self) -> dict[str, float]:
        """Return the inputs of the displayed state."""
        message = self.hub.newest().get(topic(self.name, INPUTS))
        return self._values((message and read_document(message.payload)) or {})

    def _values(self, told: Mapping[str, Any]) -> dict[str, float]:
        """Return the inputs in a document, as far as they are in the units of commands."""
        units = {one.name: one.unit for one in self.gate.inputs}
        known = [(str(row.get("name")), row.get("unit"), row.get("value")) for row in rows_of(told, "inputs")]
        return {name: float(v) for name, unit, v in known if unit == units.get(name, "") and is_number(v)}


def _top(limit: float | None, unit: str) -> float:
    return float(limit) if limit is not None and np.isfinite(limit) else LARGEST_RANGE[unit]
