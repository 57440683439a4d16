"""A run as arrays, as a table, as a figure, as a page, and beside the truth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from results import bar_robot
from small_run import make_run

import femsense as fs
from femsense.core.errors import InputError
from femsense.report.text import run_document, run_text
from femsense.rig.truth_files import CONTACT_COLUMNS
from femsense.sensing.comparison import TrueContact, read_truth
from femsense.sensing.run_arrays import sensed, tracks_of
from femsense.sensing.types import Run


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return make_run(bar_robot(tmp_path))


def test_forces_and_places_stand_frame_by_frame_and_nan_where_none_is(run: Run) -> None:
    assert run.forces.shape == run.positions.shape == (3, 2, 3)
    for row, contact in ((1, run.contacts[0]), (2, run.contacts[2])):
        np.testing.assert_array_equal(run.forces[row, 0], contact.force_n_xyz)
        np.testing.assert_array_equal(run.positions[row, 0], contact.position_m)
    np.testing.assert_array_equal(run.forces[1, 1], run.contacts[1].force_n_xyz)
    assert np.isnan(run.forces[0]).all() and np.isnan(run.forces[2, 1]).all()


def test_a_contact_keeps_its_column_by_its_track(run: Run) -> None:
    first, second, third = (replace(c, track=track) for c, track in zip(run.contacts, (7, 3, 7)))
    tracked = replace(run, contacts=(first, second, third))
    assert tracks_of(tracked) == (3, 7)
    np.testing.assert_array_equal(tracked.forces[2, 1], third.force_n_xyz)
    assert np.isnan(tracked.forces[2, 0]).all()


def test_one_contact_over_time_is_counted_once(run: Run, tmp_path: Path) -> None:
    pressing = [replace(run.contacts[0], frame=k, force_n=1.0, std_n=0.01, track=5) for k in (1, 4)]
    one = replace(run, contacts=tuple(pressing))
    assert "1 contact, up to" in repr(one) and "1 in 2 frames" in run_text(one)
    folder = fs.write_run(one, tmp_path / "run", inputs={})
    assert json.loads((folder / "run.json").read_text(encoding="utf-8"))["contacts"] == 1
    two = replace(one, contacts=(pressing[0], replace(pressing[1], track=6)))
    assert "2 contacts, up to" in repr(two) and "2 in 2 frames" in run_text(two)


def test_a_run_as_a_table(run: Run, tmp_path: Path) -> None:
    pytest.importorskip("pandas")
    table = run.to_dataframe()
    fs.write_run(run, tmp_path / "run", inputs={})
    header = (tmp_path / "run" / "contacts.csv").read_text().splitlines()[0]
    assert list(table.columns) == header.split(",")
    assert table.frame.tolist() == [1, 1, 4]
    np.testing.assert_array_equal(table[["fx_n", "fy_n", "fz_n"]].to_numpy()[2], run.contacts[2].force_n_xyz)


def test_short_words(run: Run) -> None:
    assert repr(run).startswith("Run(") and "3 frames, 2 ok; 2 contacts, up to" in repr(run)
    assert "no contact" in repr(replace(run, contacts=()))


def test_a_figure_of_the_forces(run: Run) -> None:
    (axes,) = run.plot().axes
    assert axes.get_ylabel().startswith("force") and axes.get_xlabel() == "time [s]"
    (axes,) = replace(run, contacts=()).plot().axes
    assert axes.get_ylabel() == "residual [mm]" and len(axes.lines) == 2


def test_a_run_beside_the_truth(run: Run, tmp_path: Path) -> None:
    near = replace(run.contacts[2], position_m=np.array([0.05, 0.0, 0.03]), force_n_xyz=np.array([0.0, 0.0, -1.1]))
    sensed = replace(run, contacts=tuple(replace(contact, std_n=1e-3) for contact in (run.contacts[0], near)))
    truth = (TrueContact(4, np.array([0.05, 0.002, 0.03]), np.array([0, 0, -1.0])), TrueContact(0, np.zeros(3), np.ones(3)))
    found = fs.compare(sensed, truth)
    assert (found.contacts_found, found.contacts_true, found.contacts_false) == (1, 2, 1)
    np.testing.assert_allclose([found.force_errors_n[0], found.force_shares[0], found.place_errors_m[0]], [0.1, 0.1, 0.002])
    assert repr(found) == "Comparison(1 of 2 contacts in frames found, 1 that are none; median errors 0.1 N (10.0 %), 2 mm)"
    assert "0 of 0 contacts" in repr(fs.compare(sensed, ()))
    with pytest.raises(InputError, match="no truth beside the recording"):
        fs.compare(sensed, tmp_path)


def test_forces_that_noise_may_make_are_no_contacts(run: Run) -> None:
    """A ramp that begins at nothing: of three frames at a given place one has a contact, and of its three truths two are."""
    place = np.array([0.05, 0.0, 0.03])
    rows = [(0, 0.0006, 0.0015, 0.0), (1, 0.01, 0.005, 0.02), (4, 1.0, 0.005, 1.01)]
    felt = [
        replace(run.contacts[0], frame=k, force_n_xyz=np.array([0.0, 0.0, -f]), force_n=f, std_n=std, position_m=place, track=0)
        for k, f, std, _ in rows
    ]
    ramp = replace(run, contacts=tuple(felt))
    found = fs.compare(ramp, [TrueContact(k, place, np.array([0.0, 0.0, -true])) for k, *_, true in rows])
    assert (found.contacts_found, found.contacts_true, found.contacts_false) == (1, 2, 0)
    assert np.isfinite(found.force_shares).all()
    assert "1 contact, up to 1 N" in repr(ramp) and "no contact" in repr(replace(run, contacts=tuple(felt[:2])))
    assert (run_document(ramp)["contacts"], run_document(ramp)["frames_with_contact"]) == (1, 1)


def test_a_contact_that_one_component_tells_surely_is_one(run: Run) -> None:
    """What bends a finger is known well, what pulls along it hardly: its size is 2.3 deviations, one component 14."""
    bent = {"force_n_xyz": np.array([-0.14, 0.0, 0.02]), "force_n": 0.141, "std_n": 0.06}
    sure = replace(run.contacts[0], **bent, force_std_n_xyz=np.array([0.01, 0.01, 0.4]))
    unsure, untold = replace(sure, force_std_n_xyz=np.array([0.06, 0.06, 0.4])), replace(sure, force_std_n_xyz=np.zeros(3))
    assert sensed([sure, unsure, untold]) == [sure]


def test_a_truth_of_another_recording_or_robot_is_refused(run: Run, tmp_path: Path) -> None:
    own, copy, other, faster, foreign = (tmp_path / name for name in ("own", "copy", "other", "faster", "foreign"))
    rows = [f"{frame.frame},{frame.time_s},3.25" for frame in run.frames]
    for folder, robot, text in (
        (own, run.robot.name, rows),
        (copy, run.robot.name, rows),
        (other, run.robot.name, [row.replace("3.25", "4.5") for row in rows]),
        (faster, run.robot.name, [row.replace(",", ",9", 1) for row in rows]),
        (foreign, "arm", rows),
    ):
        (folder / "truth").mkdir(parents=True)
        (folder / "truth" / "contacts.csv").write_text("frame,x_m,y_m,z_m,fx_n,fy_n,fz_n\n", encoding="utf-8")
        (folder / "truth" / "truth.json").write_text(f'{{"format": "femsense-truth-1", "robot": "{robot}"}}', encoding="utf-8")
        (folder / "frames.csv").write_text("\n".join(["frame,time_s,tension_top", *text, "99,99,0"]) + "\n", encoding="utf-8")
    known = replace(run, recording_folder=own)
    assert fs.compare(known, own).contacts_true == fs.compare(known, copy).contacts_true == 0
    assert fs.compare(replace(run, recording_folder=None), other).contacts_true == 0  # nothing says that it is not
    for folder, said in ((other, "another recording"), (faster, "another recording"), (foreign, "another robot")):
        with pytest.raises(InputError, match=f"the truth of {said}"):
            fs.compare(known, folder)
    (faster / "frames.csv").unlink()
    with pytest.raises(InputError, match="the truth of another recording"):
        fs.compare(known, faster)


def test_a_truth_as_the_rig_writes_it_is_read(tmp_path: Path) -> None:
    values = dict.fromkeys(CONTACT_COLUMNS, "0") | {"frame": "4", "x_m": "0.05", "fz_n": "-1", "object": "ball"}
    (tmp_path / "truth").mkdir()
    (tmp_path / "truth" / "contacts.csv").write_text(",".join(values) + "\n" + ",".join(values.values()) + "\n", encoding="utf-8")
    (true,) = read_truth(tmp_path)
    assert true.frame == 4 and true.position_m[0] == 0.05 and true.force_n_xyz[2] == -1.0


def test_the_page_in_a_notebook(run: Run, tmp_path: Path) -> None:
    from urllib.request import urlopen

    page = tmp_path / "dist"
    page.mkdir()
    (page / "index.html").write_text("<title>a page</title>")
    shown = fs.show_run(run, height=300, page=page)
    try:
        frame = shown._repr_html_()
        assert f'<iframe src="{shown.url}"' in frame and "height:300px" in frame
        assert b"a page" in urlopen(shown.url).read() and urlopen(shown.url + "robot.glb").read()[:4] == b"glTF"
    finally:
        shown.stop()


def test_the_largest_force_of_a_line_is_of_a_frame_that_is_ok(run: Run) -> None:
    strong = replace(run.contacts[2], force_n=5.0, std_n=0.1)
    spoiled = replace(run, contacts=(run.contacts[0], strong))
    (bad,) = (frame.frame for frame in run.frames if frame.status != "ok")
    assert "up to 5 N" in repr(spoiled)
    assert "5 N" not in repr(replace(spoiled, contacts=(run.contacts[0], replace(strong, frame=bad))))
    assert "1 contact, in frames that are not ok" in repr(replace(spoiled, contacts=(replace(strong, frame=bad),)))
    (axes,) = replace(spoiled, contacts=(replace(strong, frame=bad),)).plot().axes
    assert "frame not ok" in [text.get_text() for text in axes.get_legend().get_texts()]
