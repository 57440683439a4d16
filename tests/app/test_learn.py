"""`femsense learn`: from two files to a model, to another day, and to a corrected model."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from femsense.app.cli import run
from femsense.xr.proprioception.model_file import load_model


def write_day(folder: Path, seed: int, shift: float = 0.0, rows: int = 160) -> list[str]:
    """Write readings and markers of a finger that bends in a plane, and return the two paths."""
    folder.mkdir()
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 6)
    bend = 1.2 * np.sin(0.11 * np.arange(rows) + phase) * np.sin(0.023 * np.arange(rows) + 1)
    s = np.array([0.02, 0.04, 0.06])
    with (folder / "s.csv").open("w") as sensors, (folder / "m.csv").open("w") as markers:
        sensors.write("frame,time_s,light,dark\n")
        markers.write("frame,marker,x_m,y_m,z_m\n")
        for i, turn in enumerate(bend):
            sensors.write(f"{i},{0.05 * i:.3f},{np.tanh(turn) + 0.002 * rng.normal():.6f},1.5\n")
            angle = turn * s / s[-1] + 1e-9
            for name, x, z in zip("abc", s * (1 - np.cos(angle)) / angle + shift, s * np.sin(angle) / angle):
                noise = 1e-4 * rng.normal(size=3)
                markers.write(f"{i},{name},{x + noise[0]:.7f},{noise[1]:.7f},{z + noise[2]:.7f}\n")
    return [str(folder / "s.csv"), str(folder / "m.csv")]


def test_learn_then_another_day(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files, other = write_day(tmp_path / "one", 1), write_day(tmp_path / "two", 2, shift=0.01, rows=40)
    model, mended = tmp_path / "finger.onnx", tmp_path / "mended.onnx"
    assert run(["learn", *files, "-o", str(model), "--bones", "4", "--plane", "0,1,0", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["path"] == str(model) and document["error_mm"] < 0.6 and document["dead"] == ["dark"]
    assert len(load_model(model).bone_names) == 4 and document["frame"] == "markers"
    assert run(["learn", *other, "-o", str(mended), "--adapt", str(model)]) == 0
    said = capsys.readouterr().out
    assert (
        "not the robot's" in said and "base moved: " in said and "corrected by a rigid motion: " in said and "written: " in said
    )
    assert "interval holds within a session only. From the session that was learnt to this one the error had grown" in said
    assert run(["learn", *other, "-o", str(mended), "--adapt", str(model), "--test", *files, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    tested = document["test"]
    assert list(tested["marker_error_mm"]) == ["a", "b", "c"] and all(
        9.0 < error < 11.0 for error in tested["marker_error_mm"].values()
    )  # what the first day lacks [mm]
    assert tested["coverage"] < 0.1 and document["error_mm"] == document["adapted"]["error_mm"] < 0.6 < tested["error_mm"]
    assert run(["learn", *other, "-o", str(mended), "--adapt", str(model), "--plane", "0,1,0"]) == 2
    assert "keeps its bones" in capsys.readouterr().err
    row = [0.4, 1.5]
    moved = load_model(mended).markers(row) - load_model(model).markers(row)
    np.testing.assert_allclose(moved, np.tile([0.01, 0, 0], (3, 1)), atol=5e-4)
    assert run(["learn", *files, "--test", *other, "-o", str(model)]) == 0
    said = capsys.readouterr().out
    assert "8 bones along a, b, c, in this order" in said
    assert "end-to-end network" not in said
    assert run(["learn", *files, "-o", str(model), "--end-to-end"]) == 0
    assert run(["learn", *other, "-o", str(mended), "--adapt", str(model)]) == 0
    assert "the end-to-end network is left out" in capsys.readouterr().out and load_model(mended).bones is None
    assert run(["learn", *files, "-o", str(model), "--robot-frame"]) == 0
    assert "bones are in the robot's frame" in capsys.readouterr().out and load_model(model).frame == "robot"
    assert (
        "of the markers: a " in said
        and "24 rows that were held out" in said
        and "s.csv: " in said
        and "mm on 40 rows (95 % interval" in said
        and "base moved: " in said  # why the other day is far off
        and "interval holds within a session only" in said
        and "never changes: dark" in said
        and "light" in said
    )


def test_several_recordings_and_two_markers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, two = write_day(tmp_path / "one", 1), write_day(tmp_path / "two", 2)
    model = tmp_path / "finger.onnx"
    assert run(["learn", *one, *two, "-o", str(model), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["sessions"] == 2 and document["rows"] + document["test_rows"] == 320
    assert document["interval"]["coverage"] > 0.9 and len(load_model(model).interval([0.4, 1.5])) == 3
    for file in (one[1], two[1]):
        lines = [line for line in Path(file).read_text(encoding="utf-8").splitlines() if ",c," not in line]
        Path(file).write_text("\n".join(lines) + "\n", encoding="utf-8")
    assert run(["learn", *one, *two, "-o", str(model)]) == 0
    said = capsys.readouterr().out
    assert "each was predicted from the others" in said and "straight line for lack of data" in said
    assert run(["learn", *one, two[0], "-o", str(model)]) == 2
    assert "come in pairs" in capsys.readouterr().err


def test_what_is_wrong_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = write_day(tmp_path / "few", 1, rows=30)
    assert run(["learn", *files, "-o", str(tmp_path / "m.onnx")]) == 1
    assert "at least 60 are needed" in capsys.readouterr().err and not (tmp_path / "m.onnx").exists()
    sensors, markers = write_day(tmp_path / "millimetres", 1)
    head, *rows = Path(markers).read_text(encoding="utf-8").splitlines()
    numbers = [row.split(",") for row in rows]
    larger = [",".join([*row[:2], *(f"{1e3 * float(value):.4f}" for value in row[2:])]) for row in numbers]
    Path(markers).write_text("\n".join([head, *larger]), encoding="utf-8")
    assert run(["learn", sensors, markers, "-o", str(tmp_path / "m.onnx")]) == 1
    assert "are they in millimetres" in capsys.readouterr().err and not (tmp_path / "m.onnx").exists()
    assert run(["learn", files[0], files[0], "-o", str(tmp_path / "m.onnx")]) == 2
    assert run(["learn", *files, "-o", str(tmp_path / "m.onnx"), "--plane", "up"]) == 2
    assert "not a direction" in capsys.readouterr().err
