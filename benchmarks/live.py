"""How old a force is when it comes: a software camera at 30 Hz and 848 × 480, actuation over MQTT, recording on.

    python benchmarks/live.py --robot FOLDER [--seconds 60] [--elements tet4] [--load] [-o FOLDER]
    python benchmarks/live.py --case bar-normal --seconds 600 [-o FOLDER]

The virtual rig renders two seconds of a robot that is touched; a software camera in a process of its own repeats them at 30 Hz. Inputs come
through the broker mosquitto where it is installed, else through the embedded one.
Printed are the ages of answers (from the exposure of the frame to its forces), the sustained rate, what became of every frame,
the memory of the session at its beginning and its end, and whether `estimate` gives the numbers of the session. `--load` keeps one
core busy with something else. No camera takes part: exposure, transfer by USB and the driver are not in these figures.

`--case` takes a scene of `benchmarks/independent` instead, made by another solver, at its own five frames a second again and again, and grades it as a
recording is graded: forces, false alarms a minute, and by how much the median error of the last minute differs from that of the first.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import shutil
import socket
import subprocess
import tempfile
import time
import tomllib
import warnings
from pathlib import Path
from threading import Event, Thread

import numpy as np
import tomli_w
from independent.cases import CASES
from independent.grade import Row, grade, heading
from independent.make import make

from femsense.calib.calibrate import calibrate
from femsense.calib.calibration import Calibration
from femsense.calib.files import read_calibration, write_calibration
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.live.actuation import make_actuation
from femsense.live.feed import CameraFeed, FeedOptions
from femsense.live.figures import Stopwatch
from femsense.live.growing import make_scratch, remove_scratch
from femsense.live.senser import Answer
from femsense.live.session import Session, SessionOptions
from femsense.model.robot import Robot
from femsense.rig.simulate import simulate
from femsense.sensing.pipeline import estimate
from femsense.sensing.run_files import read_run
from femsense.xr.stream.hub import Hub
from femsense.xr.stream.mqtt import EmbeddedBroker, broker_address, make_client

FRAMES, FREE, RATE_HZ = 60, 24, 30.0
TOPIC = "bench/inputs"
SEED = 1


def main() -> None:
    """Render, sense, replay, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", type=Path)
    parser.add_argument("--case", choices=sorted(case.name for case in CASES if not case.name.startswith("diamond")))
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--elements", choices=("tet4", "tet10"), default="tet4")
    parser.add_argument("--load", action="store_true", help="keep one core busy")
    parser.add_argument("-o", "--output", type=Path, help="keep the session here")
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory(prefix="femsense-bench-") as scratch:
        work = asked.output or Path(scratch)
        work.mkdir(parents=True, exist_ok=True)
        if asked.case:
            _print_graded(asked.case, work, asked.seconds)
            return
        if asked.robot is None:
            parser.error("--robot or --case is needed")
        robot = _robot(asked.robot, asked.elements, work)
        recording = _recording(robot, work)
        busy = multiprocessing.get_context("spawn").Process(target=_spin, daemon=True)
        if asked.load:
            busy.start()
        figures = _session(robot, recording, work, asked.seconds)
        if asked.load:
            busy.kill()
        figures |= {"elements": asked.elements, "one core loaded": asked.load, "replay": _replay(robot, work / "session")}
        print(json.dumps(figures, indent=2))


def _robot(folder: Path, element: str, work: Path) -> Path:
    """Return a copy of a robot with these elements, in one colour."""
    target = work / "robot"
    if not target.exists():
        shutil.copytree(folder, target)
        document = tomllib.loads((target / "robot.toml").read_text(encoding="utf-8"))
        document["mesh"]["element"] = element
        document["appearance"] = {"color_rgb": [0.2, 0.45, 0.8]}
        (target / "robot.toml").write_text(tomli_w.dumps(document), encoding="utf-8")
    return target


def _recording(robot: Path, work: Path) -> Path:
    """Return two seconds at 30 Hz: a ball presses on the free node that is farthest from the clamp, and goes away again."""
    target = work / "recording"
    if target.exists():
        return target
    body = load_robot(robot).body
    nodes = body.mesh.nodes
    point = nodes[np.linalg.norm(nodes - nodes[body.clamped].mean(axis=0), axis=1).argmax()]
    middle, size = nodes.mean(axis=0), float(np.linalg.norm(np.ptp(nodes, axis=0)))
    push = [0.4 * np.sin(np.pi * k / 24) for k in range(25)] + [0.0] * (FRAMES - FREE - 25)
    first, step = (0.3, 0.5) if body.mesh.is_quadratic else (0.5, 1.5)  # quadratic elements are softer: larger forces buckle legs
    pulls = {name: first + step * i for i, name in enumerate(body.cable_names)}  # unequal: a symmetric robot has several poses
    script = {
        "format": "femsense-script-1",
        "seed": 3,
        "dt_s": 1.0 / RATE_HZ,
        "sweeps": [
            {"label": "rest", "levels": [1.0] * FREE, "cables": pulls},
            {"label": "touch", "levels": [1.0] * (FRAMES - FREE), "cables": pulls},
        ],
        "contacts": [{"sweep": "touch", "point_m": point.tolist(), "force_n": push, "object": "ball"}],
        "objects": [{"name": "ball", "kind": "ball", "radius_m": 0.05 * size}],
        "truth": {"refinements": 0, "element": "tet10" if body.mesh.is_quadratic else "tet4", "law": "corotational"},
        "clouds": {"kind": "depth"},
        "markers": {"names": []},
        "camera": {
            "width": 848,
            "height": 480,
            "fx": 600.0,
            "eye_m": (middle + 1.6 * size * np.array([0.6, -0.5, 0.6])).tolist(),
            "target_m": middle.tolist(),
            "noise": {"kind": "stereo"},
        },
    }
    (work / "script.toml").write_text(tomli_w.dumps(script), encoding="utf-8")
    simulate(load_robot(robot), work / "script.toml", target)
    return target


def _print_graded(name: str, work: Path, seconds: float) -> None:
    """Run a session on a scene of another solver, and print how far its forces are off."""
    folder = work / "case"
    if not (folder / "truth.json").exists():
        make(next(case for case in CASES if case.name == name), folder, SEED)
    figures = _session(folder / "robot", folder / "recording", work, seconds, with_frames=True)
    run = read_run(work / "session" / "run")
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    own: dict[int, list[dict[str, object]]] = {}
    for contact in truth["contacts"]:
        own.setdefault(contact["frame"], []).append(contact)
    numbers = [frame.frame for frame in run.frames if not np.isnan(frame.ms)]

    def graded(chosen: list[int]) -> Row:
        file = work / "truth.json"
        again = [one | {"frame": number} for number in chosen for one in own.get(number % truth["frames"], ())]
        file.write_text(json.dumps(truth | {"contacts": again, "numbers": chosen}), encoding="utf-8")
        return grade(work / "session" / "run", file)

    whole, minute = graded(numbers), int(60.0 / np.diff([frame.time_s for frame in run.frames]).mean())
    first, last = (float(np.median(graded(part).size_error)) for part in (numbers[:minute], numbers[-minute:]))
    print(heading(), whole.line(), whole.deviations(), sep="\n")
    alarms = whole.false / (seconds / 60.0 * whole.calm / max(len(numbers), 1))
    figures |= {
        "false alarms a minute without touch": round(alarms, 2),
        "median error of the first and the last minute": [first, last],
    }
    print(json.dumps(figures | {"replay": _replay(folder / "robot", work / "session")}, indent=2))


def _session(robot: Path, recording: Path, work: Path, seconds: float, *, with_frames: bool = False) -> dict[str, object]:
    """Run a session of so many seconds of sensing and return its figures; with_frames: inputs come with the frames, not over MQTT."""
    body, seen = load_robot(robot), load_recording(recording)
    stop, scratch = Event(), make_scratch()
    broker = _Mosquitto(work) if shutil.which("mosquitto") else EmbeddedBroker(Hub(), port=0)
    inputs = dict(zip([f"cable_{name}" for name in seen.cable_names], seen.inputs[0].tolist()))
    sender = Thread(target=_send, args=(broker.port, inputs, stop), daemon=True)
    sender.start()
    shutil.rmtree(work / "session", ignore_errors=True)
    calibration = write_calibration(_calibration(body, recording), work / "calibration.json")
    ages, around = Stopwatch(window_s=float("inf")), Stopwatch(window_s=float("inf"))

    def answered(answer: Answer, taken_s: float) -> None:
        now = time.monotonic()
        ages.add(now, now - taken_s)
        around.add(now, now - taken_s - 1e-3 * np.nan_to_num(answer.report.ms))

    feed = CameraFeed(f"software:{recording}", FeedOptions(ring=scratch.name), on_skipped=lambda frame: session.skipped(frame))
    session = Session(
        body,
        feed,
        scratch,
        actuation=None if with_frames else make_actuation(f"mqtt://127.0.0.1:{broker.port}/{TOPIC}", body),
        options=SessionOptions(
            calibration=calibration,
            folder=work / "session",
            actuation=seen.actuation,
            actuation_zero=seen.actuation_zero,
            contact_free_frames=int(seen.free.sum()) if with_frames and seen.free is not None else 12,
        ),
        on_answer=answered,
    )
    begun, memory, before = None, 0.0, feed.counts
    try:
        while begun is None or time.monotonic() - begun < seconds:
            if session.step(0.1) is not None and begun is None:
                begun, memory, before = time.monotonic(), _memory_mb(), feed.counts
    finally:
        after, grown = feed.counts, _memory_mb()
        session.close()
        stop.set()
        broker.close()
        remove_scratch(scratch)
    found, other, received = ages.latency(), around.latency(), after.received - before.received
    return {
        "seconds": seconds,
        "broker": "none" if with_frames else type(broker).__name__.strip("_"),
        "cores": len(os.sched_getaffinity(0)),
        "load average": os.getloadavg()[0],
        "photon to force p50 / p95 / p99 [ms]": [round(1e3 * v, 1) for v in (found.p50_s, found.p95_s, found.p99_s)],
        "of these, outside of the estimator [ms]": [round(1e3 * v, 1) for v in (other.p50_s, other.p95_s, other.p99_s)],
        "rate [1/s]": round(found.rate_hz, 2),
        "frames received, skipped, missed, not delivered": [
            received,
            after.skipped - before.skipped,
            after.missed - before.missed,
            after.dropped - before.dropped,
        ],
        "frames lost by the recording": session.lost.count,
        "memory at the beginning and the end [MB]": [round(memory), round(grown)],
        "events": {event.kind.value: [event.count, event.text] for event in session.log.totals()},
    }


class _Mosquitto:
    """The broker mosquitto, in a process of its own."""

    def __init__(self, folder: Path) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        file = folder / "mosquitto.conf"
        file.write_text(f"listener {self.port} 127.0.0.1\nallow_anonymous true\n", encoding="ascii")
        self._process = subprocess.Popen(["mosquitto", "-c", str(file)], stderr=subprocess.DEVNULL)
        time.sleep(1.0)

    def close(self) -> None:
        """End the broker."""
        self._process.terminate()
        self._process.wait()


def _calibration(body: Robot, recording: Path) -> Calibration:
    """Return the calibration of every fourth contact-free frame: their inputs are the same, and quadratic elements take minutes for all."""
    seen = load_recording(recording)
    assert seen.free is not None
    return calibrate(body, seen, frames=np.flatnonzero(seen.free)[::4].tolist())


def _replay(robot: Path, session: Path) -> str:
    """Return in words whether `estimate` gives the numbers of a session."""
    live = read_run(session / "run")
    again = estimate(load_robot(robot), load_recording(session), read_calibration(session / "calibration.json"))
    told = [
        [(f.frame, f.time_s, f.status, f.matched, f.rms_before_m, f.rms_after_m) for f in run.frames] for run in (live, again)
    ]
    forces = [c.force_n for c in live.contacts] == [c.force_n for c in again.contacts][: len(live.contacts)]
    states = np.array_equal(live.states.nodes_m, again.states.nodes_m[: len(live.states.nodes_m)])
    return f"{len(live.frames)} frames, forces {forces}, states {states}, reports {told[0] == told[1][: len(told[0])]}"


def _send(port: int, inputs: dict[str, float], stop: Event) -> None:
    """Send the inputs over MQTT 100 times a second, with the sender's time."""
    client = make_client(broker_address(f"mqtt://127.0.0.1:{port}"))
    client.connect("127.0.0.1", port)
    client.loop_start()
    while not stop.wait(0.01):
        client.publish(TOPIC, json.dumps({"time_s": time.time(), **inputs}))
    client.loop_stop()


def _spin() -> None:
    while True:
        sum(range(10_000))


def _memory_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


if __name__ == "__main__":
    main()
