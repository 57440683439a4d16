"""Results to write and read: a calibration, a loop, and what their files have to hold."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from helpers import write_block_robot

from femsense.calib.calibration import Calibration
from femsense.io.files import PART_PREFIX
from femsense.io.robot_toml import load_robot
from femsense.loop.result.loop_result import LoopResult
from femsense.loop.result.records import DataCard, Errors, FrameError, Left, NamedEffect, Structure, Value, WorstMarker
from femsense.model.robot import Robot

NAN = float("nan")


def bar_robot(folder: Path) -> Robot:
    """Return a robot of a few elements with a file of its own."""
    return load_robot(write_block_robot(folder, cells=(2, 1, 1), cables__0__path_m=[[0.1, 0.015, 0.03]]))


def make_calibration(**changes: Any) -> Calibration:
    rng = np.random.default_rng(3)
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    T = np.eye(4)
    T[:3, :3] = R * np.sign(np.linalg.det(R))
    T[:3, 3] = rng.normal(size=3)
    half = rng.normal(size=(6, 6))
    calibration = Calibration(
        T_robot_camera=T,
        poses=(T, np.eye(4)),
        camera_names=("left", "right"),
        cable_tension_n={"top": 0.1 + 0.2, "side": 0.0},
        cable_displacement_m={"top": 1e-3, "side": -2e-4},
        rms_m=1 / 3000,
        marker_rms_m={"tip": 2e-4},
        history=(0.1,),
        pose_std=rng.random((4, 4)),
        pose_covariance=half @ half.T,
        tension_std_n={"top": 0.01, "side": None},
        displacement_std_m={"top": 1e-5, "side": None},
        status="converged",
        placements_m={"tip": [0.1, 0.0, 0.03]},
        frames=(0, 4),
    )
    return replace(calibration, **changes)


def what_is_left() -> Left:
    """What a residual looks like, made by hand."""
    frame, still = FrameError(0, 3, 1e-4), Structure(0.0, 1.0, {}, significant=False)
    where = WorstMarker("tip", (0.1, 0.0, 0.0), (0.0, 0.0, 1e-4), (0.0, 0.0, 1.0), 0.9)
    return Left(1e-4, {"tip": 1e-4}, where, frame, (frame,), 0.5, (), held_out=False, structure=still, explained_share=1.0)


def make_loop(robot: Robot) -> LoopResult:
    entry = {"name": "cable_friction", "coefficient": 0.12}
    rms = Errors(1e-3, NAN, (0.0, np.inf), "sweeps")
    return LoopResult(
        verdict="effects",
        sentence="the cables rub",
        noise_m=1e-4,
        before=rms,
        after=rms,
        entries=(entry,),
        candidates=(),
        confounded=(),
        effects=(NamedEffect("cable_friction", {"coefficient": Value(0.12, 0.01, "1")}, 2e-3, 1e-3),),
        next_experiment="",
        not_testable=(),
        detectable={},
        left=what_is_left(),
        robot=robot,
        declared=robot,
        data=DataCard((), (), (), (), ("markers",), None, {"white": 1e-4}, "start", None, (), 12.0, {}, 1e-3),
    )


def same(a: Any, b: Any) -> None:
    """Assert that two objects are the same, NaN included."""
    if isinstance(a, np.ndarray):
        np.testing.assert_array_equal(a, b)
    elif isinstance(a, tuple | list):
        assert len(a) == len(b)
        for x, y in zip(a, b):
            same(x, y)
    elif isinstance(a, dict):
        assert list(a) == list(b)
        same(list(a.values()), list(b.values()))
    elif hasattr(a, "__dataclass_fields__"):
        for field in fields(a):
            same(getattr(a, field.name), getattr(b, field.name))
    else:
        assert a == b or (a != a and b != b), (a, b)


def strict_json(path: Path) -> Any:
    """Return the content of a JSON file that has no NaN and no Infinity."""

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is not JSON")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


def nothing_half_written(folder: Path) -> bool:
    return not [path for path in folder.rglob("*") if PART_PREFIX in path.name]
