"""The Unity package reads the bytes that are sent: by a transcript that both sides check, and by mono where it is installed."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from glb import ROOT

from femsense.xr.stream.hub import Message
from femsense.xr.stream.payloads import in_unity, pose_bytes
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
    return lines


def test_the_transcript_is_what_is_sent() -> None:
    assert TRANSCRIPT.read_text(encoding="utf-8").splitlines() == transcript()


@pytest.mark.skipif(shutil.which("mcs") is None or shutil.which("mono") is None, reason="no mono on this machine")
def test_unity_s_part_reads_the_transcript(tmp_path: Path) -> None:
    program = tmp_path / "transcript.exe"
    sources = [str(UNITY / "Runtime" / "Messages.cs"), str(UNITY / "Tests" / "Transcript.cs")]
    subprocess.run(["mcs", f"-out:{program}", *sources], check=True, capture_output=True, timeout=60)
    done = subprocess.run(["mono", str(program), str(TRANSCRIPT)], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0 and "6 lines agree" in done.stdout, done.stdout
