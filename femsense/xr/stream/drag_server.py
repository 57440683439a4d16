"""Replies to a dragged point: inputs by a `Follower`, the shape that the robot can reach, and commands while armed and held.

One client controls the robot at a time (`lease`), and every client can stop it. Each request is answered with the state of the search;
while the request is unchanged, replies continue until the search ends.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import count
from threading import Event, Lock, Thread
from typing import Any

import numpy as np
import numpy.typing as npt

from femsense.calib.calibration import Calibration
from femsense.control.follow import Follower
from femsense.control.motion import CONVERGING, REACHED, STOPPED, Motion
from femsense.control.search import ReachOptions
from femsense.core.arrays import FloatArray, diagonal
from femsense.fem.mesh import embed_points
from femsense.model.robot import Robot
from femsense.xr.skinning import Skin, prepare_poses
from femsense.xr.stream.command_gate import CommandGate, GateOptions
from femsense.xr.stream.drag_messages import Wish, in_plain_words, read_report, read_wish
from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.lease import Lease, Ruling
from femsense.xr.stream.payloads import Handle, Input, Kind, bone_rows, document_bytes, pose_bytes, topic
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
        self.gate, self.lease = CommandGate(drive_inputs(robot), self.options.gate), Lease(self.options.gate.hold_s)
        self._size = diagonal(robot.body.mesh.nodes)
        self.feedback = TipFeedback(self._size, self.options.feedback)
        self._follower = Follower(
            robot,
            limits={one.name: (one.low, one.high) for one in self.gate.inputs},
            calibration=calibration,
            options=ReachOptions(tolerance_m=self.options.tolerance_m),
        )
        self._skin, self._fit = embed_points(robot.body.mesh, skin.rest), prepare_poses(skin)
        self._bones: FloatArray | None = None
        self._motion: Motion | None = None
        self._wish: Wish | None = None
        self._grabbed = False  # whether a point was grabbed since the last answer
        self._wanted: tuple[str, tuple[float, ...]] | None = None
        self._still_since = 0.0
        self._told: tuple[float, dict[str, float]] = (float("-inf"), {})  # when the robot reported its inputs, and which
        self._unmeasured = (float("-inf"), "")  # when a reason came why it is not measured, and which
        self._measured_at: dict[str, float] = {}  # marker → when it was measured last
        self._settled_since: float | None = None
        self._answer: tuple[FloatArray, dict[str, Any]] | None = None
        self._numbers: defaultdict[Kind, count[int]] = defaultdict(count)
        self._fresh, self._stop, self._lock, self._telling = Event(), Event(), Lock(), Lock()
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

    def _message(self, kind: Kind, **told: Any) -> Message:
        """Return a document, numbered among those of its kind."""
        return Message(topic(self.name, kind), document_bytes(next(self._numbers[kind]), time.time(), **told))

    def _rows(self, values: Mapping[str, float]) -> list[dict[str, Any]]:
        """Return inputs as documents list them."""
        return [{"name": one.name, "unit": one.unit, "value": values[one.name]} for one in self.gate.inputs if one.name in values]

    # ---- wishes

    def _hear(self, message: Message, who: str) -> None:
        if topic(message.robot, message.kind) != topic(self.name, message.kind):
            return
        if message.kind == Kind.MEASURED:
            self._measure(message.payload)
        elif message.kind == Kind.DRAG:
            self._take(message, who)
        elif message.kind == Kind.STOP:
            self.stop()

    def _measure(self, payload: bytes) -> None:
        """Store the measured position of the dragged marker, and the inputs that the robot reports."""
        report, now = read_report(payload, self.gate.inputs), time.monotonic()
        with self._lock:
            self._measured_at.update(dict.fromkeys(report.places_m, now))
            if report.detail:
                self._unmeasured = (now, report.detail)
            place = report.places_m.get(self._wish.handle) if self._wish is not None else None
            if place is not None and self._is_near(place):
                self.feedback.measured(now, place)
            if report.inputs:
                self._told = (now, report.inputs)

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
        self._wish, self._grabbed = None, False

    def _take(self, message: Message, who: str) -> None:
        wish, now = read_wish(message.payload, who), time.monotonic()
        if wish is None or not self._can_be_meant(wish):
            return
        with self._lock:
            ruling = self.lease.rule(wish, now)
            if ruling is Ruling.RELEASED:
                self._let_go()
            elif ruling in (Ruling.GRANTED, Ruling.RENEWED):
                if ruling is Ruling.GRANTED or self._wish is None or wish.handle != self._wish.handle:
                    self._let_go()
                    self._grabbed = True
                if ruling is Ruling.RENEWED:
                    self.gate.hold(now, armed=wish.armed)
                self._wish = wish
        if ruling is not Ruling.RENEWED:
            self._say_who_steers()
        self._fresh.set()

    def _say_who_steers(self) -> None:
        held = self.lease
        told = {"client": held.client, "number": held.number, "expires_s": held.hold_s, "stopped": held.stopped}
        self.hub.publish([self._message(Kind.LEASE, **told)])

    def _can_be_meant(self, wish: Wish) -> bool:
        """Return whether a wish is for a marker of the robot, and not far away from it."""
        if not wish.held:
            return True
        return wish.handle in self.robot.glued_names and wish.target_m is not None and self._is_near(wish.target_m)

    def _is_near(self, place_m: FloatArray) -> bool:
        return float(np.linalg.norm(place_m - self.robot.body.mesh.nodes.mean(axis=0))) <= FAR * self._size

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

    def answer(self, handle: str, target_m: npt.ArrayLike) -> Motion:
        """Advance the search for a request, publish the result, and set it as the target of the gate.

        Measurements of the point while the robot is at rest correct the model's target (see `tip_feedback`).
        """
        begun, target = time.perf_counter(), np.asarray(target_m, dtype=np.float64)
        with self._lock:
            turn, grabbed, self._grabbed = self.gate.turn, self._grabbed, False
            moves = self.options.gate.allowed and self._wish is not None and self._wish.armed
            current = {**self.gate.last, **self._current()} if moves else self._shown()
            last, since = self._motion, self._settled()
            wanted = self.feedback.target(
                time.monotonic(),
                target,
                settled_since=since,
                reached_m=None if last is None else last.reached_m.get(handle),
                arrived=last is not None and last.status == REACHED,
            )
        if grabbed and len(current) == len(self.gate.inputs):
            self._follower.begin(current)
        if (asked := (handle, tuple(target.tolist()))) != self._wanted:
            self._wanted, self._still_since = asked, begun
        stays = begun - self._still_since >= self.options.rest_s
        motion = self._follower.step({handle: wanted}, seconds=self.options.answer_s, stays=stays)
        if motion.equilibrium.converged:
            self._motion = motion
            with self._lock:
                self.gate.want(motion.inputs, turn=turn)
        self._bones = self._fit(self._skin.positions(motion.positions), start=self._bones)
        off = float(
            np.linalg.norm(self.feedback.expected(motion.reached_m[handle]) - target)
        )  # the search used the corrected target
        self._tell((self._bones, self._document(handle, replace(motion, error_m=off), 1e3 * (time.perf_counter() - begun))))
        return motion

    def _tell(self, answer: tuple[FloatArray, dict[str, Any]] | None = None) -> None:
        """Publish an answer, or the newest once more, with whether commands go out now."""
        with self._telling:
            self._answer = answer or self._answer
            if self._answer is None:
                return
            bones, document = self._answer
            ghost = pose_bytes(next(self._numbers[Kind.GHOST]), time.time(), bone_rows(bones))
            reach = self._message(Kind.REACH, **document, armed=self.gate.moving)
            self.hub.publish([Message(topic(self.name, Kind.GHOST), ghost), reach])

    def _settled(self) -> float | None:
        """Return since when the commanded inputs are those of the newest answer, or None."""
        if self._motion is None or self._motion.status in (STOPPED, CONVERGING) or not self.gate.arrived:
            self._settled_since = None
        elif self._settled_since is None:
            self._settled_since = time.monotonic()
        return self._settled_since

    def _why_not_measured(self, handle: str) -> str:
        """Return in words why a point is not corrected; empty if it is measured, or was never measured."""
        fresh, now, (told_at, why) = self.options.feedback.fresh_s, time.monotonic(), self._unmeasured
        ago = now - self._measured_at.get(handle, float("-inf"))
        if ago <= fresh or not (self._measured_at or why):
            return ""
        if now - told_at <= fresh:
            return f"; not measured: {why}"
        return f"; not measured: {f'nothing for {ago:.1f} s' if np.isfinite(ago) else f'no measured position of {handle} is'}"

    def _document(self, handle: str, motion: Motion, ms: float) -> dict[str, Any]:
        missed = self.feedback.missed_m
        measured = self._why_not_measured(handle) if np.isnan(missed) else f"; measured {1e3 * missed:.1f} mm away from there"
        is_known = self.gate.last or len(self._reported()) == len(self.gate.inputs) or not self.options.gate.allowed
        return {
            "status": motion.status,
            "text": in_plain_words(motion) + measured + ("" if is_known else BEGINS),
            "error_m": motion.error_m,
            "measured_error_m": missed,
            "correction_m": float(np.linalg.norm(self.feedback.correction_m)),
            "ms": ms,
            "inputs": self._rows(motion.inputs),
        }

    # ---- commands

    def _command_all(self) -> None:
        """Send commands while the gate allows them; report once when it closes."""
        was_moving = False
        while not self._stop.wait(1.0 / self.options.gate.command_hz):
            with self._lock:
                inputs = self.gate.step(time.monotonic(), self._current())
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
        told = {"armed": armed, "expires_s": self.options.gate.hold_s, "inputs": self._rows(inputs)}
        self.hub.publish([self._message(Kind.COMMAND, **told)])

    def _reported(self) -> dict[str, float]:
        """Return the inputs that the robot reports on `measured`, unless that is too long ago."""
        at, inputs = self._told
        return inputs if time.monotonic() - at <= self.options.feedback.fresh_s else {}

    def _current(self) -> dict[str, float]:
        """Return the robot's inputs, as far as it reports them.

        Before the first command the topic `inputs` is used too; after it this is not valid: a replayed run would report its recorded inputs.
        """
        return self._reported() if self.gate.last else {**self._shown(), **self._reported()}

    def _shown(self) -> dict[str, float]:
        """Return the inputs of the displayed state."""
        message = self.hub.newest().get(topic(self.name, Kind.INPUTS))
        return {} if message is None else read_report(message.payload, self.gate.inputs).inputs


def _top(limit: float | None, unit: str) -> float:
    return float(limit) if limit is not None and np.isfinite(limit) else LARGEST_RANGE[unit]
