"""Messages of a session: poses and forces as in `stream`, wrenches as ROS messages, and the state of the session."""

from __future__ import annotations

import json
import time
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from femsense.calib.calibration import Calibration
from femsense.core.arrays import FloatArray, freeze
from femsense.fem.compliance import drive_rows, tangent_at
from femsense.fem.equilibrium import solve_equilibrium
from femsense.fem.mesh import surface_triangles
from femsense.live.events import SessionEvent
from femsense.live.figures import Snapshot
from femsense.live.senser import Answer
from femsense.model.robot import Robot, spread_features
from femsense.xr.gltf import glb_bytes
from femsense.xr.landmarks import Landmark, Landmarks
from femsense.xr.skinning import fit_skin, prepare_poses
from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.payloads import Contact, Input, Twin, TwinFrame, bone_rows, header, topic
from femsense.xr.stream.publisher import Publisher, PublishOptions

WRENCH, LIVE = "wrench", "live"
BONES = 16
PUSHES = 6
"""Number of places where the body is pushed to generate deformations for the skin."""
MOVED = 0.1
"""Size of these deformations, relative to the body's diagonal."""


class Outlet:
    """One robot that is streamed during sensing."""

    def __init__(self, hub: Hub, robot: Robot, calibration: Calibration | None = None) -> None:
        """Announce the robot; its skin is fitted to deformations of the linearised model, which takes seconds."""
        self.hub, self.robot = hub, robot
        mesh = robot.body.mesh
        triangles = surface_triangles(mesh)
        self._used, corners = np.unique(triangles, return_inverse=True)
        rest = mesh.nodes[self._used]
        skin = fit_skin(rest, _typical_states(robot)[:, self._used], bones=BONES)
        still = np.tile(skin.skeleton.T_robot_bone, (1, 1, 1, 1))
        glb = glb_bytes(rest, corners.reshape(-1, 3), skin, still, [0.0], color_rgb=robot.color_rgb, name=robot.name)
        cameras = () if calibration is None else (Landmark("the camera", freeze(calibration.T_robot_camera[:3, 3])),)
        markers = tuple(Landmark(name, freeze(point)) for name, point in zip(robot.marker_names, robot.marker_points))
        twin = Twin(
            robot.name,
            glb,
            skin.skeleton.names,
            skin.skeleton.T_robot_bone,
            inputs=_inputs(robot),
            landmarks=Landmarks(markers, cameras),
        )
        self._fit, self._poses = prepare_poses(skin), skin.skeleton.T_robot_bone
        self.publisher = Publisher(hub, twin, PublishOptions(waits_for="the camera"))
        self._last: tuple[TwinFrame, float] | None = None
        self._seq = 0

    def show(self, answer: Answer, taken_s: float) -> None:
        """Send a result; `taken_s`: exposure time of its frame [s, monotonic clock]."""
        self._poses = self._fit(answer.positions[self._used], start=self._poses)
        report = answer.report
        frame = TwinFrame(
            report.time_s,
            bone_rows(self._poses),
            tuple(_contact(contact) for contact in answer.contacts),
            inputs=(*report.tension_n.values(), *report.pressure_pa.values()),
            residual_m=report.rms_after_m,
            status=report.status,
            frame=report.frame,
            read_at=taken_s,
        )
        self._last = frame, taken_s
        self.publisher.publish(frame)
        stamp = time.time() - (time.monotonic() - taken_s)
        self.hub.publish([Message(topic(self.robot.name, WRENCH), wrench_bytes(self._seq, stamp, answer))])
        self._seq += 1

    def tell(self, snapshot: Snapshot, now_s: float) -> None:
        """Send the state of the session; while the camera is lost, repeat the last result with its status and age."""
        if snapshot.answer is None:
            doing = f"{snapshot.phase}: {snapshot.todo}" if snapshot.todo else snapshot.phase
            self.publisher.options = replace(self.publisher.options, waits_for=f"the first forces ({doing})")
        elif self._last is not None and _is_lost(snapshot):
            frame, taken_s = self._last
            text = f"{snapshot.link.text(now_s)}; the last result is {now_s - taken_s:.1f} s old"
            self.publisher.publish(replace(frame, status=text, read_at=taken_s))
        self.publisher.watch()
        self.hub.publish([Message(topic(self.robot.name, LIVE), live_bytes(snapshot, now_s))])

    def end(self) -> None:
        """Announce the end of the stream."""
        self.publisher.end()


def wrench_bytes(seq: int, stamp_s: float, answer: Answer) -> bytes:
    """Return the sum of all contact forces and their torque about the origin of the robot frame, as geometry_msgs/WrenchStamped."""
    force, torque = np.zeros(3), np.zeros(3)
    for contact in answer.contacts:
        force += contact.force_n_xyz
        torque += np.cross(contact.position_m, contact.force_n_xyz)
    wrench = {"force": _xyz(force), "torque": _xyz(torque)}
    return json.dumps({"header": header(seq, stamp_s, "robot"), "wrench": wrench}, allow_nan=False).encode()


def live_document(snapshot: Snapshot, now_s: float) -> dict[str, object]:
    """Return the state of a session as plain values; unknown numbers are left out."""
    latency, counts = snapshot.latency, snapshot.counts
    values: dict[str, object] = {
        "phase": str(snapshot.phase),
        "todo": snapshot.todo,
        "link": snapshot.link.state.value,
        "link_text": snapshot.link.text(now_s),
        "camera": snapshot.camera,
        "link_speed": snapshot.link_speed,
        "answer_age_s": now_s - snapshot.taken_s,
        "status": "" if snapshot.answer is None else snapshot.answer.report.status,
        "rate_hz": latency.rate_hz,
        "latency_p50_s": latency.p50_s,
        "latency_p95_s": latency.p95_s,
        "latency_p99_s": latency.p99_s,
        "frames_received": counts.received,
        "frames_used": snapshot.used,
        "frames_skipped": counts.skipped,
        "frames_missed": counts.missed,
        "frames_dropped": counts.dropped,
        "recording_lost": snapshot.lost.count,
        "notices": [event_document(event, snapshot.begun_s, now_s) for event in snapshot.notices],
        "recording": snapshot.recording,
        "parts": list(snapshot.parts),
    }
    return {key: value for key, value in values.items() if not (isinstance(value, float) and not np.isfinite(value))}


def event_document(event: SessionEvent, begun_s: float, now_s: float) -> dict[str, object]:
    """Return an event as plain values, with times since the start of the session, `begun_s`."""
    return {
        "kind": event.kind.value,
        "text": event.text,
        "time_s": round(event.begun_s - begun_s, 3),
        "duration_s": round(event.duration_s(now_s), 3),
        "lasts": event.ended_s > now_s,
        "count": event.count,
    }


def live_bytes(snapshot: Snapshot, now_s: float) -> bytes:
    """Return `live_document` as JSON."""
    return json.dumps(live_document(snapshot, now_s), allow_nan=False, separators=(",", ":")).encode()


def _is_lost(snapshot: Snapshot) -> bool:
    from femsense.live.link import LOST

    return snapshot.link.state in LOST or snapshot.link.attempts > 0


def _typical_states(robot: Robot) -> FloatArray:
    """Return deformations of the linearised model [m], shape (k, n, 3): by each input, and by forces at places spread over the surface."""
    body = robot.body
    state = solve_equilibrium(body)
    tangent = tangent_at(body, state)
    count = len(body.mesh.nodes)
    forces = list(drive_rows(body, state.positions).reshape(-1, count, 3))
    for place in spread_features(body, PUSHES):
        for direction in np.eye(3):
            force = np.zeros((count, 3))
            force[place] = direction
            forces.append(force)
    moves = tangent.respond(np.array(forces))
    size = np.linalg.norm(np.ptp(body.mesh.nodes, axis=0))
    largest = np.linalg.norm(moves, axis=2).max(axis=1)[:, None, None]
    moves = MOVED * size * moves / np.maximum(largest, 1e-12)
    return np.concatenate([state.positions[None], state.positions + moves])


def _inputs(robot: Robot) -> tuple[Input, ...]:
    cables = [Input(c.name, "N", 0.0, _range(c.max_tension, 10.0)) for c in robot.body.cables]
    return (*cables, *(Input(c.name, "Pa", 0.0, _range(c.max_pressure, 1e5)) for c in robot.body.chambers))


def _range(declared: float, usual: float) -> float:
    return declared if np.isfinite(declared) else usual


def _contact(c: object) -> Contact:
    from femsense.sensing.types import ContactForce

    assert isinstance(c, ContactForce)
    return Contact(
        contact=c.contact,
        point_m=c.position_m,
        force_n=c.force_n_xyz,
        std_n=c.std_n,
        force_std_n=c.force_std_n_xyz,
        point_std_m=c.position_std_m,
        radius_m=c.radius_m,
        source=c.source,
        track=c.track,
    )


def _xyz(vector: npt.NDArray[np.float64]) -> dict[str, float]:
    x, y, z = (float(v) for v in vector)
    return {"x": x, "y": y, "z": z}
