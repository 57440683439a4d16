"""What the demo measures, says and draws; the chain itself with its slow steps replaced."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import write_block_robot
from small_run import make_run

from femsense.app.demo import demo
from femsense.app.demo.picture import draw_demo
from femsense.app.demo.truth import force_errors, true_effects
from femsense.core.errors import InputError
from femsense.io.clouds.images import read_png
from femsense.io.robot_toml import load_robot, robot_names
from femsense.loop.files import saved_loop
from femsense.model.robot import Robot
from femsense.report.loop.text import effect_text, loop_text
from femsense.report.text import columns, run_text
from femsense.sensing.comparison import TrueContact, read_truth
from femsense.sensing.types import Run

LOOP: dict[str, Any] = {
    "verdict": "effects",
    "sentence": "the cables rub",
    "noise_m": 1e-4,
    "before": {"train_rms_m": 2e-3, "validation_rms_m": 2.5e-3},
    "after": {"train_rms_m": 3e-4, "validation_rms_m": None},
    "effects": [
        {
            "name": "cable_friction",
            "parameters": {
                "coefficient": {"value": 0.1234, "std": 0.01, "unit": "1"},
                "offset": {"value": {"top": 1.0}, "std": {"top": 0.5}, "unit": "N"},
            },
            "validation_rms_before_m": 2.5e-3,
            "validation_rms_after_m": 4e-4,
        }
    ],
    "next_experiment": "pull slower",
    "confounded": [],
}


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return load_robot(
        write_block_robot(tmp_path_factory.mktemp("robot"), cells=(2, 1, 1), cables__0__path_m=[[0.1, 0.015, 0.03]])
    )


@pytest.fixture
def run(robot: Robot) -> Run:
    """Three contacts of 1 N along z: one in frame 1 at the tip, one in frame 1 far from it, one in frame 4 at the tip."""
    base = make_run(robot)
    places = ([0.1, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.0, 0.002])
    force = np.array([0.0, 0.0, 1.0])
    contacts = tuple(
        replace(c, position_m=np.array(p), force_n_xyz=force, force_n=1.0, std_n=0.1) for c, p in zip(base.contacts, places)
    )
    return replace(base, contacts=contacts)


TRUTH = (
    TrueContact(1, np.array([0.1, 0.0, 0.0]), np.array([0.0, 0.0, 0.8])),
    TrueContact(4, np.array([0.1, 0.0, 0.0]), np.array([0.0, 0.3, 1.0])),
    TrueContact(0, np.array([0.1, 0.0, 0.0]), np.array([0.0, 0.0, 0.5])),
)


def test_errors_against_the_truth(run: Run) -> None:
    errors = force_errors(run, TRUTH)
    assert (errors["contacts_true"], errors["contacts_found"], errors["contacts_false"]) == (3, 2, 1)
    np.testing.assert_allclose(errors["force_error_n"], 0.25)
    np.testing.assert_allclose(errors["force_error_share"], np.median([0.25, 0.3 / np.hypot(0.3, 1.0)]))
    np.testing.assert_allclose(errors["place_error_m"], 0.001)
    nothing = force_errors(replace(run, contacts=()), TRUTH)
    assert nothing["contacts_found"] == 0 and nothing["force_error_n"] is None


def test_a_recording_without_truth_has_none(tmp_path: Path) -> None:
    assert read_truth(tmp_path) == () and true_effects(tmp_path) == []


def test_columns_are_aligned() -> None:
    assert columns([["a", "b"], ["long", "c"], ["alone"]]) == "  a     b\n  long  c\n  alone"


def test_texts_name_what_matters(run: Run) -> None:
    text = run_text(run)
    assert "2 of 3" in text and "2 in 2 frames" in text and "0.500 N declared, 0.490 N sensed (-2.0 %)" in text
    assert "no result, frame 0" in text and "1.000 ± 0.100 N (1 σ) in frame 1" in text
    text = loop_text(saved_loop(LOOP))
    assert (
        text.startswith("verdict: effects (the cables rub)")
        and "2.000 → 0.300 mm" in text
        and "next experiment: pull slower" in text
    )
    text = effect_text(saved_loop(LOOP).effects[0])
    assert "0.1234 ± 0.01\n" in text and "top 1 ± 0.5 N" in text and "2.500 → 0.400 mm" in text


def test_known_loads_are_listed_up_to_six(run: Run) -> None:
    loads = tuple(replace(run.known_loads[0], frame=frame) for frame in range(8))
    text = run_text(replace(run, known_loads=loads))
    assert text.count("N declared") == 6 and "2 frames more" in text


def said(document: dict[str, Any]) -> str:
    return loop_text(saved_loop(document))


def test_what_would_have_been_seen_and_what_is_left_are_said_in_a_line() -> None:
    sizes = {
        "cable_gain": {"smallest": {"scale[a]": 1.02, "scale[b]": 1.05}, "kind": "factor", "unit": "1", "would_be_seen": True},
        "payload": {"smallest": {"force_n[0]": 0.012}, "kind": "change", "unit": "N", "would_be_seen": True},
        "base_compliance": {"smallest": {"stiffness_n_m": 340.0}, "kind": "softer_than", "unit": "N/m"},
        "creep": {"smallest": {"fraction": 2.4}, "kind": "change", "unit": "1", "would_be_seen": False},
        "gravity": {"smallest": {"vector_m_s2[2]": 1.0}, "kind": "change", "unit": "m/s²", "would_be_seen": True},
        "hyperelastic": {"smallest": {}, "would_be_seen": True},
    }
    left = {
        "rms_m": 1e-3,
        "where": {"marker": "tip"},
        "worst_frame": {"frame": 7},
        "held_out": True,
        "goes_with": [{"covariate": "time", "p_holm": 0.2}, {"covariate": "cable north", "p_holm": 0.01}],
    }
    text = said({"verdict": "none", "detectable": sizes, "not_testable": [{"name": "gravity"}], "left": left})
    assert (
        "would have been seen: cable_gain (a factor of 1.05), payload (0.012 N), base_compliance (softer than 340 N/m)\n" in text
    )
    assert text.endswith("what is left: 1 mm rms in held-out data, most at marker tip, in frame 7, going with cable north")
    assert "would have been seen" not in said({"verdict": "effects", "detectable": sizes})
    on_body = {"rms_m": 1e-3, "where": {"marker": "surface 103", "position_m": [0.0119, -0.02, 0.1]}}
    assert said({"verdict": "none", "left": on_body}).endswith("most at (12, -20, 100) mm on the body")


def test_a_frame_that_no_force_explains_is_said(run: Run) -> None:
    def text(*after_mm: float) -> str:
        one = next(frame for frame in run.frames if frame.status == "ok")
        frames = [replace(one, frame=k, rms_after_m=1e-3 * rms) for k, rms in enumerate(after_mm)]
        return run_text(replace(run, frames=tuple(frames)))

    assert "2 of 6 frames, most frame 4: off by 8.8 mm" in text(0.3, 0.3, 0.4, 3.5, 8.8, 1.1)
    assert "not explained" not in text(0.3, 0.3, 0.4, 1.1)
    assert "not explained" not in text(0.0, 0.0, 0.0, 0.3)  # no camera is that good
    assert "1 of 5 frames, most frame 4" in text(np.nan, 0.3, 0.3, 0.3, 3.5)
    assert "not explained" not in run_text(replace(run, frames=()))


def test_the_closing_table_and_the_picture(run: Run, tmp_path: Path) -> None:
    document = demo.demo_document(
        tmp_path, run, LOOP, replace(run, contacts=()), TRUTH, [{"name": "cable_friction", "coefficient": 0.2}]
    )
    text = demo.demo_text(document)
    for words in (
        "error of force (median)  0.25 N          –",
        "2 of 3",
        "effects of the truth:\n  cable_friction  coefficient 0.2",
        f"femsense view {tmp_path / 'run'}",
    ):
        assert words in text, text
    for after, truth in ((run, TRUTH), (run, ()), (replace(run, contacts=()), ())):
        image = read_png(draw_demo(run, after, truth, document, tmp_path / "picture.png"))
        assert image.shape[1] > 1000 and 0.02 < float((image[..., :3].min(axis=2) < 200).mean()) < 0.6


def test_the_chain(run: Run, tmp_path: Path) -> None:
    calls: list[tuple[str, str]] = []
    steps = demo.DemoSteps(
        estimate=lambda folder, robot, *_, **__: (calls.append((folder.name, str(robot))), run)[1],
        improve=lambda folder, robot, *_, **__: (calls.append((folder.name, str(robot))), LOOP)[1],
    )
    said: list[str] = []
    document = demo.run_demo(tmp_path / "out", say=said.append, steps=steps)
    assert calls == [("declared", "four-leg"), ("loop", "four-leg"), ("run", str(tmp_path / "out" / "loop"))]
    assert [line[:3] for line in said[:4]] == ["1/4", "2/4", "3/4", "4/4"]
    assert {"robot.glb", "picture.png", "demo.json"} <= {path.name for path in (tmp_path / "out").iterdir()}
    assert document["declared"]["contacts_true"] == len(read_truth(demo.demo_recording(robot_names()))) > 0


@pytest.mark.parametrize("name", ["four-leg", "other"])
def test_a_missing_recording_is_named(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="the demo's recording is not in this installation"):
        demo.demo_recording({name: tmp_path})
