"""The Unity package reads the bytes that are sent: by a transcript that both sides check, and by mono where it is installed."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from glb import ROOT
from streams import documented, moment

from femsense.xr.stream.hub import Message
from femsense.xr.stream.payloads import force_bytes, in_unity, pose_bytes, status_bytes
from femsense.xr.stream.websocket import pack

UNITY = ROOT / "unity"
TRANSCRIPT = UNITY / "Tests" / "transcript.txt"


def transcript() -> list[str]:
    """Frames of a WebSocket in hexadecimal, their topic, and sequence, time and bones in Unity's frame;
    a broken pose has none."""
    rng = np.random.default_rng(3)
    lines = []
    for k in range(5):
        bones = rng.normal(size=(k + 1, 7)).astype(np.float32)
        bones[:, 3:] /= np.linalg.norm(bones[:, 3:], axis=1, keepdims=True)
        topic, pose = f"femsense/arm-{k}/pose", pose_bytes(1000 * k, 0.125 * k, bones)
        numbers = [1000 * k, 0.125 * k, *in_unity(bones).ravel()]
        lines.append(" ".join([pack([Message(topic, pose)]).hex(), topic, *(f"{v:.9g}" for v in numbers)]))
    lines.append(f"{pack([Message('femsense/arm/pose', pose[:-1])]).hex()} femsense/arm/pose")
    return lines + [f"{pack([Message(name, payload)]).hex()} {name} {said}" for name, payload, said in documents()]


def documents() -> list[tuple[str, bytes, str]]:
    """Topic and payload of what is said about a robot, and how Unity's part has to understand it."""
    doubtful = replace(moment(0.5, contact=True), status='light = 9 is outside 0 … 1, by "far"')
    answer = documented("reach") | {"status": "converging", "text": "nearer ones follow", "error_m": 0.00125}
    arrived = answer | {"status": "reached", "text": "reached to 0.01 mm", "error_m": 1e-05}
    found = [
        ("status", status_bytes("waiting", "readings"), "state=waiting old=False detail=readings since_s=NaN"),
        ("status", status_bytes("live"), "state=live old=False detail= since_s=NaN"),
        ("status", status_bytes("stale", since_s=1764201600.5), "state=stale old=True detail= since_s=1764201600.5"),
        ("status", status_bytes("lost", "127.0.0.1:1883"), "state=lost old=True detail=127.0.0.1:1883 since_s=NaN"),
        ("status", status_bytes("ended"), "state=ended old=True detail= since_s=NaN"),
        ("force", force_bytes(9, doubtful), 'status=light_=_9_is_outside_0_…_1,_by_"far"'),
        ("reach", json.dumps(answer).encode(), "status=converging final=False text=nearer_ones_follow error_m=0.00125"),
        ("reach", json.dumps(arrived).encode(), "status=reached final=True text=reached_to_0.01_mm error_m=1E-05"),
    ]
    return [(f"femsense/arm/{kind}", payload, said) for kind, payload, said in found]


def test_the_transcript_is_what_is_sent() -> None:
    assert TRANSCRIPT.read_text(encoding="utf-8").splitlines() == transcript()


@pytest.mark.skipif(shutil.which("mcs") is None or shutil.which("mono") is None, reason="no mono on this machine")
def test_unity_s_part_reads_the_transcript(tmp_path: Path) -> None:
    program = tmp_path / "transcript.exe"
    sources = [str(UNITY / "Runtime" / "Messages.cs"), str(UNITY / "Tests" / "Transcript.cs")]
    subprocess.run(["mcs", f"-out:{program}", *sources], check=True, capture_output=True, timeout=60)
    done = subprocess.run(["mono", str(program), str(TRANSCRIPT)], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0 and "14 lines agree" in done.stdout, done.stdout
