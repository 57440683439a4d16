"""How much of what a finer mesh would change does a truth on another mesh show, and is it the same share in all sweeps?

    python benchmarks/mesh_share.py
    python benchmarks/mesh_share.py --finer 3 --each 3   # truths with three times the declared cells along each side

Of blind cases in which nothing is hidden (seeds of `loop.py tune`), with pose and modulus as in the truth: D,
how far the truth's markers lie from the declared robot's; E, how far a mesh of half the size moves them
(`femsense.loop.fit.discretisation_error`); the share a of E that is nearest to D in all sweeps, and in the sweeps one by one;
what is left of D beside it; and what is left beyond what calibration may move (pose, modulus, zeros) of D alone, beside one share
of E, and beside one matrix times E.
"""

from __future__ import annotations

import argparse
import warnings

import numpy as np
from loop import COUNTS, SEEDS
from loop_cases import Case, make_cases, make_data

from femsense import Robot, apply_effects
from femsense.core.arrays import FloatArray
from femsense.loop.data.dataset import Data, prepare
from femsense.loop.fit.discretisation_error import mesh_errors, with_mesh_errors
from femsense.loop.fit.fitted_model import fit_model, with_nuisance
from femsense.loop.fit.joint_fit import JointFit, JointProblem, Prior
from femsense.loop.fit.noise_components import Noise
from femsense.model.as_it_is import evaluate_robot
from femsense.model.observation import Hypothesis


def rms_mm(field: FloatArray) -> float:
    return 1e3 * float(np.sqrt((field**2).sum(axis=1).mean()))


def compared(case: Case) -> None:
    """Print the line of one case."""
    made = make_data(case, SEEDS["tune"])
    robot = apply_effects(made.declared, [{"name": "stiffness", "scale": made.modulus_scale}])
    data = prepare(robot, [made.recording], ())
    stage = fit_model(data, Hypothesis(data.robot), Prior(np.zeros(0), np.zeros(0)), Noise({"white": 5e-4}, ""), np.zeros(0))
    errors = mesh_errors(with_mesh_errors(data, stage, []))
    if not errors:
        print(f"{case.number:4d} {case.design.name:7s}{case.control:13s} no state settles on the finer mesh", flush=True)
        return
    E, trial = errors[0], data.train[0]
    D = np.array([made.truth[f, m] for f, m in zip(trial.scene.frame, trial.scene.marker)]) - model(stage.fit, robot, data)
    share = float((D * E).sum() / (E**2).sum())
    sweep = trial.groups.sweep
    own = [float((D[sweep == s] * E[sweep == s]).sum() / (E[sweep == s] ** 2).sum()) for s in np.unique(sweep)]
    print(
        f"{case.number:4d} {case.design.name:7s}{case.control:13s} D {rms_mm(D):5.2f}  E {rms_mm(E):5.2f} mm  a "
        f"{share:5.2f}  left {rms_mm(D - share * E):5.2f} mm"
        f"  beyond calibration {beyond(data, D, E)} mm  sweeps {'  '.join(f'{a:5.2f}' for a in own)}",
        flush=True,
    )


def beyond(data: Data, D: FloatArray, E: FloatArray) -> str:
    """Return what is left of D [mm] beyond calibration: of all of it, beside a E, and beside A E with any 3 × 3 matrix A."""
    hypothesis, prior = with_nuisance(data)
    problem = JointProblem(hypothesis, prior, data.train, [], data.placement_std)
    jet = problem.jet(data.train[0], np.zeros(data.train[0].size), np.zeros(len(prior.mean)), True)
    J = np.concatenate([jet.by_pose, jet.by_initial, jet.by_effect], axis=2).reshape(D.size, -1)
    J = J[:, np.linalg.norm(J, axis=0) > 0]
    J = J / np.linalg.norm(J, axis=0)
    turned = (np.eye(3)[None, :, :, None] * E[:, None, None, :]).reshape(D.size, 9)
    left = []
    for columns in (J, np.column_stack([J, E.ravel()]), np.column_stack([J, turned])):
        share = np.linalg.lstsq(columns, D.ravel(), rcond=1e-9)[0]
        left.append(rms_mm((D.ravel() - columns @ share).reshape(D.shape)))
    return "  ".join(f"{mm:5.3f}" for mm in left)


def model(fit: JointFit, robot: Robot, data: Data) -> FloatArray:
    """Return the declared robot's markers in the rows of the first trial [m], robot frame, (k, 3)."""
    trial = data.train[0]
    poses, initial = trial.place(fit.fit.theta[: fit.own], data.robot.marker_points.mean(axis=0))
    states = evaluate_robot(robot, trial.scene, poses, initial).states
    return np.array([robot.markers.positions(states[int(f)].positions)[m] for f, m in zip(trial.scene.frame, trial.scene.marker)])


def main() -> None:
    """Print a line for each case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--finer", type=int, default=None, help="cells of truths along each side, in units of the declared ones")
    parser.add_argument("--each", type=int, default=6, help="cases of each way to drive")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    cases = [case for case in make_cases(SEEDS["tune"], COUNTS, options.finer) if case.kind == "null"]
    for control in ("displacement", "tension"):
        for case in [c for c in cases if c.control == control][: options.each]:
            compared(case)


if __name__ == "__main__":
    main()
