"""Results in a few lines of text."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import write_block_robot
from results import NAN, make_calibration
from small_run import make_run

from femsense.io.robot_toml import load_robot
from femsense.loop.files import saved_loop
from femsense.report.loop.text import loop_text
from femsense.report.text import calibration_text, known_part, run_text
from femsense.report.write import write_report
from femsense.sensing.run_files import read_run, write_run
from femsense.sensing.types import ContactForce


@pytest.mark.parametrize(("noise_m", "said"), [(3e-4, True), (1.2e-2, False), (NAN, False)])
def test_a_residual_far_above_the_noise_is_said_to_be_an_error_of_the_model(noise_m: float, said: bool) -> None:
    text = calibration_text(make_calibration(rms_m=2.5e-2, noise_m=noise_m))
    assert ("error of the model  24.998 mm of it: markers repeat to 0.300 mm" in text) == said


def test_inputs_that_are_absolute_have_nothing_at_the_start() -> None:
    known = {"tension_std_n": {"top": 0.0}, "displacement_std_m": {"top": 0.0}}
    text = calibration_text(make_calibration(cable_tension_n={"top": 0.0}, cable_displacement_m={"top": -5.9e-4}, **known))
    assert "cable top" not in text and "at the start" not in text
    unknown = {"tension_std_n": {"top": 0.02}, "displacement_std_m": {"top": 1e-4}}
    text = calibration_text(make_calibration(cable_tension_n={"top": 0.4}, cable_displacement_m={"top": 2e-3}, **unknown))
    assert "0.400 N ± 0.02 N, 2.00 mm ± 0.1 mm at the start" in text


def test_a_loop_says_how_large_the_error_of_the_model_is() -> None:
    parts = {"held_out_m": 0.0121, "noise_source": "marker_noise_m of recording.toml"}
    text = loop_text(saved_loop({"verdict": "unexplained", "model_error": parts}))
    assert "12.100 mm held out, beyond noise and discretisation; noise: marker_noise_m of recording.toml" in text
    assert "error of the model" not in loop_text(saved_loop({"verdict": "none"}))


def test_what_was_fitted_along_and_is_handed_back_is_said_with_its_values() -> None:
    along = {"cable_offset": {"offset_n": {"value": {"m1": 0.21}, "std": {"m1": 0.08}, "unit": "N"}}}
    text = loop_text(saved_loop({"verdict": "effects", "fitted_along": along}))
    title, values = text.split("cable_offset (fitted along, part of the improved robot, not named)")
    assert "verdict: effects" in title and "0.21" in values and "0.08" in values


def contact(force: list[float], std: list[float]) -> ContactForce:
    size = float(np.linalg.norm(force))
    place = np.zeros(3), np.array([0.0, 0.0, 1.0])
    return ContactForce(0, 0.0, 0, *place, np.array(force), size, 0.1, "given", force_std_n_xyz=np.array(std))


def test_a_component_that_is_not_known_is_told_apart_from_what_is() -> None:
    """A weight on a beam: along it markers hardly tell a force, and the size is too large by that."""
    text = known_part(contact([-0.23, 0.036, -0.548], [0.21, 0.019, 0.034]))
    assert text.startswith("0.549 ± 0.034 N across x; along it -0.230 ± 0.210 N")


@pytest.mark.parametrize(
    ("force", "std"),
    [
        ([-0.5, 0.036, -0.548], [0.21, 0.019, 0.034]),  # it tells itself from nothing
        ([-0.1, 0.1, -0.548], [0.1, 0.09, 0.09]),  # all are known alike
        ([-0.1, 0.1, -0.548], [NAN, NAN, NAN]),  # of a file that does not tell
    ],
)
def test_other_forces_are_told_whole(force: list[float], std: list[float]) -> None:
    assert known_part(contact(force, std)) == ""


def test_terminal_and_report_name_the_same_largest_force(tmp_path: Path) -> None:
    run = make_run(load_robot(write_block_robot(tmp_path / "robot")))
    good = next(frame.frame for frame in run.frames if frame.status == "ok")
    weak, sure = (
        replace(run.contacts[0], frame=good, contact=i, track=i, force_n=f, std_n=s)
        for i, (f, s) in enumerate(((0.9, 0.5), (0.2, 0.01)))
    )
    both = replace(run, contacts=(weak, sure))
    folder = write_run(both, tmp_path / "run", inputs={"robot": {"path": None}, "recording": {"path": None}})
    assert "largest force        0.200 ± 0.010 N" in run_text(both)
    page = write_report(folder).read_text(encoding="utf-8")
    assert "largest force 0.200 ± 0.010 N" in page.replace("\u202f", " ").replace("\u00a0", " ")


def test_a_run_whose_forces_noise_may_make_has_no_contact(tmp_path: Path) -> None:
    run = make_run(load_robot(write_block_robot(tmp_path / "robot")))
    felt = run_text(run)
    assert "the frames with contact" in felt and "largest force" in felt
    weak = run_text(replace(run, contacts=tuple(replace(one, std_n=one.force_n) for one in run.contacts)))
    assert "median of all frames" in weak and "largest force" not in weak
    assert any(line.split() == ["contacts", "none"] for line in run_text(replace(run, contacts=())).splitlines())


def test_a_contact_that_was_seen_and_whose_size_is_not_determined_is_reported_as_one(tmp_path: Path) -> None:
    run = make_run(load_robot(write_block_robot(tmp_path / "robot")))
    weak = replace(run, contacts=tuple(replace(one, force_n=0.48, std_n=0.26, source="cloud") for one in run.contacts[:1]))
    text = run_text(weak)
    assert "contacts none" not in " ".join(text.split())
    assert "a contact whose size is not determined in 1 frame" in text
    assert "contact, size not determined (0.48 ± 0.26 N)" in text and "largest force" not in text
    folder = write_run(weak, tmp_path / "run", inputs={"robot": {"path": None}, "recording": {"path": None}})
    notes = [row["note"] for row in csv.DictReader((folder / "frames.csv").open(encoding="utf-8"))]
    assert notes.count("contact, size not determined (0.48 ± 0.26 N)") == 1 and notes.count("") == len(notes) - 1
    assert len(read_run(folder, robot=run.robot).frames) == len(run.frames)
    assert "contact, size not determined (0.48 ± 0.26 N)" in write_report(folder).read_text(encoding="utf-8")
    inferred = replace(weak, contacts=tuple(replace(one, source="shape") for one in weak.contacts))
    assert any(line.split() == ["contacts", "none"] for line in run_text(inferred).splitlines())
