"""The Unity package reads the bytes that are sent: by a transcript that both sides check, and by mono where it is installed."""

from __future__ import annotations

import hashlib
import json
import re
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
TRANSCRIPT = UNITY / "Tests" / "Editor" / "transcript.txt"
STAND_INS = ROOT / "tests" / "support" / "unity_stand_ins.cs"


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


NO_MONO = pytest.mark.skipif(shutil.which("mcs") is None or shutil.which("mono") is None, reason="no mono on this machine")


@NO_MONO
def test_unity_s_part_reads_the_transcript(tmp_path: Path) -> None:
    program = tmp_path / "transcript.exe"
    sources = [UNITY / "Runtime" / "Messages.cs", UNITY / "Tests" / "Editor" / "Transcript.cs", UNITY / "Tests~" / "Program.cs"]
    subprocess.run(["mcs", f"-out:{program}", *map(str, sources)], check=True, capture_output=True, timeout=60)
    done = subprocess.run(["mono", str(program), str(TRANSCRIPT)], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0 and "14 lines agree" in done.stdout, done.stdout


@NO_MONO
def test_the_package_compiles_against_what_it_uses_of_unity(tmp_path: Path) -> None:
    sources = sorted(file for file in UNITY.rglob("*.cs") if "Tests~" not in file.parts)
    library = ["-target:library", "-define:UNITY_5_3_OR_NEWER", "-nowarn:0649", f"-out:{tmp_path / 'package.dll'}"]
    done = subprocess.run(
        ["mcs", *library, str(STAND_INS), *map(str, sources)], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0 and len(sources) == 8, done.stdout + done.stderr


def guid_of(path: str) -> str:
    """The identity of a file or folder of the package: always the same for its name."""
    return hashlib.md5(f"org.femsense.stream/{path}".encode()).hexdigest()


def test_each_file_and_folder_that_unity_sees_has_its_meta_file() -> None:
    seen = {file.relative_to(UNITY).as_posix() for file in UNITY.rglob("*") if file.suffix != ".meta"}
    hidden = {path for path in seen if path.startswith("Tests~") or path in ("Samples~", "Samples~/Desktop", "Samples~/Headset")}
    metas = {file.relative_to(UNITY).as_posix().removesuffix(".meta"): file.read_text() for file in UNITY.rglob("*.meta")}
    assert metas.keys() == seen - hidden
    for path, text in metas.items():
        assert f"guid: {guid_of(path)}\n" in text, path
        assert ("folderAsset: yes" in text) == (UNITY / path).is_dir(), path


def test_scenes_refer_to_scripts_and_assemblies_to_each_other() -> None:
    scripts = {guid_of(file.relative_to(UNITY).as_posix()) for file in UNITY.rglob("*.cs")}
    scenes = [file.read_text() for file in UNITY.rglob("*.unity")]
    assert len(scenes) == 2
    for scene in scenes:
        assert set(re.findall(r"guid: (\w+)", scene)) <= scripts
        assert set(re.findall(r"fileID: ([1-9]\d*)\}", scene)) <= set(re.findall(r"^--- !u!\d+ &(\d+)$", scene, re.MULTILINE))
    known = {"glTFast", "UnityEngine.TestRunner", "UnityEditor.TestRunner"}
    assemblies = [json.loads(file.read_text()) for file in UNITY.rglob("*.asmdef")]
    known |= {assembly["name"] for assembly in assemblies}
    assert len(assemblies) == 4 and all(set(assembly["references"]) <= known for assembly in assemblies)
    package = json.loads((UNITY / "package.json").read_text())
    assert "com.unity.cloud.gltfast" in package["dependencies"]
    assert all((UNITY / sample["path"]).is_dir() for sample in package["samples"])
