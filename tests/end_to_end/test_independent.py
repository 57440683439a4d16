"""The independent generator: its statics against a closed form, and its files by the documented commands."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from helpers import ROOT

skfem = pytest.importorskip("skfem")
sys.path.append(str(ROOT / "benchmarks"))

from independent import bodies  # noqa: E402
from independent.cases import Case, Touch  # noqa: E402
from independent.equilibrium import Problem  # noqa: E402
from independent.grade import grade  # noqa: E402
from independent.make import make  # noqa: E402
from independent.solid import Cable, Load, Solid  # noqa: E402
from independent.twin import apart, inputs_apart, script_of, truth_of  # noqa: E402

from femsense import load_robot, simulate  # noqa: E402

YOUNG, SIDE, LENGTH = 450e3, 0.02, 0.1
SLIDE = Case("slide", "arm", (Touch(tangent=0.3, slide_m=0.02),), camera="tof", images=True)


def _cantilever(kind: str, *, poisson: float = 0.0) -> Solid:
    axes = np.linspace(0, LENGTH, 11), np.linspace(-SIDE / 2, SIDE / 2, 3), np.linspace(-SIDE / 2, SIDE / 2, 3)
    mesh = (skfem.MeshHex if kind == "hex" else skfem.MeshTet).init_tensor(*axes)
    return Solid(mesh, YOUNG, poisson, 0.0, np.zeros(3), np.array([[-1, -1, -1], [0, 1, 1]]))


def _face(solid: Solid) -> np.ndarray:
    spread = np.linspace(-0.009, 0.009, 5)
    return solid.rows(np.array([[LENGTH, y, z] for y in spread for z in spread]))


@pytest.mark.parametrize("kind", ["hex", "tet"])
def test_a_loaded_tip_sinks_as_a_timoshenko_beam_does(kind: str) -> None:
    solid = _cantilever(kind)
    face = _face(solid)
    force = 1e-3
    problem = Problem(solid, [])
    pull = np.asarray(face.T @ np.full((25, 3), 1 / 25)) * np.array([0, 0, -force])
    state = problem.solve(Load(0.0, np.zeros(0), np.zeros(0), np.zeros(0, bool), pull), problem.at_rest())
    sunk = -np.asarray(face @ (state.x - solid.rest))[:, 2].mean()
    bending = force * LENGTH**3 / (3 * YOUNG * SIDE**4 / 12)
    shear = force * LENGTH / (5 / 6 * YOUNG / 2 * SIDE**2)
    assert sunk == pytest.approx(bending + shear, rel=0.02)
    proof = problem.certificate(state, np.random.default_rng(0))
    assert proof["residual_n"] < 1e-7
    assert abs(proof["energy_slope"]) < 1e-2
    assert proof["energy_curvature_j"] > 0


def test_a_cable_beside_the_axis_bends_the_bar_by_its_moment() -> None:
    solid = _cantilever("hex")
    tension, arm = 0.02, 0.006
    cable = Cable("up", solid.rows(np.array([[LENGTH, 0, arm], [LENGTH / 2, 0, arm]])), np.array([-0.02, 0, arm]))
    problem = Problem(solid, [cable])
    load = Load(0.0, np.array([tension]), np.zeros(1), np.zeros(1, bool), np.zeros_like(solid.rest))
    state = problem.solve(load, problem.at_rest())
    rise = np.asarray(_face(solid) @ (state.x - solid.rest))[:, 2].mean()
    assert rise == pytest.approx(tension * arm * LENGTH**2 / (2 * YOUNG * SIDE**4 / 12), rel=0.03)
    held = Load(0.0, np.zeros(1), problem.shortening(state.x), np.ones(1, bool), np.zeros_like(solid.rest))
    again = problem.solve(held, problem.at_rest())
    assert again.tension[0] == pytest.approx(tension, rel=1e-4)
    assert np.abs(again.x - state.x).max() < 1e-7


def test_the_truth_yields_as_on_a_finer_mesh() -> None:
    body = bodies.bar(np.random.default_rng(0))
    side = np.linspace(-SIDE / 2, SIDE / 2, 5)
    finer = skfem.MeshHex.init_tensor(LENGTH * np.linspace(0, 1, 23) ** 1.8, side, side)
    sunk = []
    for mesh in (body.truth, finer):
        solid = Solid(mesh, body.young, body.poisson, body.density, np.zeros(3), body.fixed)
        problem, face = Problem(solid, []), _face(solid)
        pull = np.asarray(face.T @ np.tile([0.0, 0.0, 1 / 25], (25, 1)))
        sunk.append(float((face @ problem.yielding(problem.at_rest(), pull[:, :, None])[:, :, 0])[:, 2].mean()))
    assert sunk[0] == pytest.approx(sunk[1], rel=0.005)


def test_forces_and_stiffness_are_derivatives_of_the_energy() -> None:
    solid = _cantilever("tet", poisson=0.45)
    rng = np.random.default_rng(3)
    x = solid.rest + 2e-4 * rng.normal(size=solid.rest.shape)
    d = rng.normal(size=x.shape) * (~solid.clamped)[:, None]
    high, low = x + 1e-6 * d, x - 1e-6 * d
    slope = (solid.strain_energy(high) - solid.strain_energy(low)) / 2e-6
    assert np.sum(solid.inner_forces(x) * d) == pytest.approx(slope, rel=1e-4)
    change = (solid.inner_forces(high) - solid.inner_forces(low)).ravel()[solid.free] / 2e-6
    product = solid.stiffness(x) @ d.ravel()[solid.free]
    assert np.abs(product - change).max() < 1e-4 * np.abs(change).max()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple:
    folder = tmp_path_factory.mktemp("independent")
    return folder, make(SLIDE, folder, 5)


def _inspect(path) -> dict:
    here = {**os.environ, "PYTHONPATH": str(ROOT)}
    words = [sys.executable, "-m", "femsense", "inspect", str(path), "--json"]
    done = subprocess.run(words, capture_output=True, text=True, env=here)
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("part", ["robot", "recording"])
def test_nothing_is_wrong_with_what_it_writes(made: tuple, part: str) -> None:
    answer = _inspect(made[0] / part)
    assert answer["problems"] == [], answer


def test_what_it_says_of_a_case_is_whole(made: tuple) -> None:
    truth = made[1]
    assert truth["certificate"]["worst_residual_n"] < 1e-6
    assert abs(truth["certificate"]["worst_energy_slope"]) < 0.05
    assert truth["certificate"]["least_energy_curvature_j"] > 0
    assert {c["frame"] for c in truth["contacts"]} == set(range(6, 16))
    first, last = truth["contacts"][0], truth["contacts"][-1]
    assert np.linalg.norm(np.subtract(first["rest"], last["rest"])) == pytest.approx(0.02, rel=0.1)
    assert np.dot(first["force"], first["normal"]) < 0


def test_the_rig_makes_the_same_scene(made: tuple, tmp_path) -> None:
    folder, truth = made
    script = script_of(SLIDE, folder)
    script["truth"]["refinements"], script["clouds"] = 0, {"kind": "none"}
    simulate(load_robot(folder / "robot"), script, tmp_path / "recording")
    there = truth_of(tmp_path, truth)
    assert inputs_apart(folder / "recording", tmp_path / "recording") < 1e-6
    free, touched = apart(truth, there)
    assert free.max() < 2e-4 and touched.max() < 2e-4  # it moves by 10 mm, on meshes that differ
    for mine, yours in zip(truth["contacts"], there["contacts"], strict=True):
        assert mine["force"] == pytest.approx(yours["force"], abs=1e-6)
        assert np.linalg.norm(np.subtract(mine["point"], yours["point"])) < 1e-3
        assert np.dot(mine["normal"], yours["normal"]) > 0.995


def test_the_grader_sees_an_error_a_miss_and_a_false_contact(tmp_path) -> None:
    true = [{"frame": 6 + k, "point": [0, 0, 0.01 * k], "force": [0, 0, -0.1 - 0.1 * k], "bound_rel": 0.05} for k in range(6)]
    true[5]["bound_rel"] = 0.5
    (tmp_path / "truth.json").write_text(json.dumps({"case": "made up", "frames": 14, "contacts": true}))
    head = "frame,time_s,contact,x_m,y_m,z_m,fx_n,fy_n,fz_n,force_n,std_n"
    rows = ["2,0.4,0,0,0,0.1,0,0,-0.5,0.5,0.1", "6,0.0,0,0,0.2,0.1,0,0,-0.5,0.5,0.1"]
    for contact in true[1:]:
        x, y, z = contact["point"]
        size = -1.1 * contact["force"][2]
        rows.append(f"{contact['frame']},0,1,{x + 0.002},{y},{z},0,0,{-size},{size},{0.03 if contact['frame'] < 9 else 0.001}")
    (tmp_path / "contacts.csv").write_text("\n".join([head, *rows]) + "\n")
    (tmp_path / "frames.csv").write_text("\n".join(["frame,status", *(f"{k},ok" for k in range(14))]) + "\n")
    row = grade(tmp_path, tmp_path / "truth.json")
    assert (row.true, row.resolvable, row.false, row.calm, row.extra) == (6, 5, 1, 8, 1)
    assert (row.missed, row.missed_quietly, row.largest_false_n) == (1, 1, 0.5)
    assert row.size_error == pytest.approx([0.1] * 4)
    assert row.vector_error == pytest.approx([0.1] * 4)
    assert row.place_m == pytest.approx([0.002] * 4)
    assert row.over_bound == pytest.approx([2.0] * 4)
    assert np.abs(row.over_std) == pytest.approx([0.02 / 0.03, 0.03 / 0.03, 40.0, 50.0])
    assert row.covered == [True, True, False, False]
