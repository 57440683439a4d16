"""What the report shows besides the verdict: figures in numbers, so that loop.json alone is enough to draw them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from femsense.calib.calibrate import usable_frames
from femsense.core.arrays import FloatArray
from femsense.fem.mesh import surface_triangles, to_linear
from femsense.loop.data.covariates import actuation_of, covariates_of, load_of, rank_with, stacked, unloading
from femsense.loop.data.dataset import NUISANCE, Data
from femsense.loop.data.holdout import sweeps_of
from femsense.loop.data.surface_rows import cloud_frames
from femsense.loop.data.trial import Trial, heads_of
from femsense.loop.fit.cross_validation import sweep_rows
from femsense.loop.fit.discretisation_error import without_mesh_error
from femsense.loop.fit.fitted_model import FittedModel
from femsense.loop.fit.joint_fit import JointFit
from femsense.loop.fit.noise_components import Noise
from femsense.loop.search.screening import TESTABLE, Candidate, one_each
from femsense.loop.verdict.force_impact import View, chosen_frames, equivalent_forces, force_consequence, views_of
from femsense.loop.verdict.residual_diagnostics import StructureTests, frame_rms, structure_tests
from femsense.model.recording import Recording, state_key

MOST_NODES = 4000
"""A skin with more corners than this is drawn at rest only."""
DRAWS = 200
"""Bootstrap draws of sweeps."""
FEW_SWEEPS = 3
MAP = 14
"""Effects in the map of confounding."""
WIDE = 6
"""Effects with more parameters than this imitate anything and are left out of that map."""
REPEATS = 6
"""Degrees of freedom of the pure error at least."""


def gather(
    data: Data,
    before: FittedModel,
    base: FittedModel,
    final: FittedModel,
    back: FittedModel,
    shown: FittedModel,
    noise: Noise,
    first: list[Candidate],
    last: list[Candidate],
    after_tests: StructureTests,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Return the content of `evidence` in loop.json.

    Arguments:
        data: the recordings, split.
        before: the declared model, calibrated.
        base: with all that calibration may move.
        final: with the effects, everything free; `back`: what is handed back; `shown`: that of the two whose residual is what is left.
        noise: at the end.
        first, last: the first and the last screening.
        after_tests: tests of structure at the end.
        rng: of the bootstrap and the permutations.
    """
    old, new = views_of(data, before), views_of(data, back)
    score, pattern = _pattern(data, old, new)
    cleaned, left = (
        [without_mesh_error(t, j.residual, noise, nor_placements=True) for t, j in zip(data.train, s.fit.jets)]
        for s in (before, shown)
    )
    found: dict[str, Any] = _rounded(
        {
            "frames": _frame_table(data, old, new, score),
            "score": pattern,
            "tip": _tip(data, old, new),
            "pictures": _pictures(data, old, new),
            "ranking": _ranking(data, base.fit, first, rng),
            "confounding": _confounding(first),
            "calibration": _calibration(data, {"before": before, "nuisance": base, "after": final}),
            "tests": {
                "before": _tests(data.train, cleaned, before.fit, structure_tests(data.train, cleaned, rng=rng)),
                "after": _tests(data.train, left, shown.fit, after_tests),
            },
            "power": _power(last),
            "excluded": [_excluded(data.train[i].scene.recording, data) for i in heads_of(data.train)],
            "repeats": sum(_repeats(data.train[i]) for i in heads_of(data.train)),
            "forces": force_consequence(old, new, noise),
            "equivalent_forces": equivalent_forces([v for v in views_of(data, shown) if not v.held_out], noise),
        }
    )
    return found


def _rounded(value: Any) -> Any:
    """Return plain tables with seven digits, NaN and infinity as null."""
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(f"{value:.7g}") if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


# Frames


def _label(view: View) -> list[str]:
    recording, frames = view.trial.scene.recording, view.trial.scene.frames
    every = sweeps_of(recording, np.arange(len(recording.time_s)))
    return [recording.sweep[k] if recording.sweep is not None else f"{every[k] + 1}" for k in frames]


def _frame_table(
    data: Data, old: list[View], new: list[View], score: list[tuple[FloatArray, FloatArray]]
) -> dict[str, list[Any]]:
    """Return one row a frame of all trials, fitted ones first."""
    table: dict[str, list[Any]] = {}
    for a, b, (first, second) in zip(old, new, score):
        scene = a.trial.scene
        frames, recording = scene.frames, scene.recording
        columns: dict[str, Sequence[Any]] = {
            "recording": [a.recording] * len(frames),
            "frame": [a.number(int(k)) for k in frames],
            "time_s": recording.time_s[frames].tolist(),
            "sweep": _label(a),
            "held_out": [a.held_out] * len(frames),
            "actuation": actuation_of(recording)[frames].tolist(),
            "unloading": unloading(recording)[frames].tolist(),
            "load_n": load_of(recording)[frames].tolist(),
            "before_rms_m": frame_rms(a.trial, a.jet.residual).tolist(),
            "after_rms_m": frame_rms(b.trial, b.jet.residual).tolist(),
            "score_before_m": first.tolist(),
            "score_after_m": second.tolist(),
        }
        for name, values in columns.items():
            table.setdefault(name, []).extend(values)
    return table


def _pattern(data: Data, old: list[View], new: list[View]) -> tuple[list[tuple[FloatArray, FloatArray]], dict[str, Any]]:
    """Return how strongly each frame shows the leading pattern of the residual before, (before, after) a trial [m], and what it goes with.

    The pattern is the first right singular vector of frames × markers, the mean of each marker over the frames of a trial taken off; a
    score is the residual's component along it over √markers, so that it compares with a root mean square.
    """
    count = len(data.robot.marker_names)
    names = sorted({int(m) for v in old for m in v.trial.scene.marker})
    fields = [(_grid(a, count), _grid(b, count)) for a, b in zip(old, new)]
    _, s, Vt = np.linalg.svd(np.vstack([f for f, _ in fields]), full_matrices=False)
    shape = Vt[0] * (1.0 if Vt[0][np.abs(Vt[0]).argmax()] > 0 else -1.0)
    scores = [(f @ shape / np.sqrt(count), g @ shape / np.sqrt(count)) for f, g in fields]
    covariates = stacked([covariates_of(v.trial.scene) for v in old])
    tables = [rank_with(np.concatenate([pair[i] for pair in scores]), covariates) for i in (0, 1)]
    best = tables[0][0]["covariate"] if tables[0] else None
    return scores, {
        "share": float(s[0] ** 2 / max(float((s**2).sum()), 1e-300)),
        "pattern": {data.robot.marker_names[i]: shape.reshape(-1, 3)[i].tolist() for i in names},
        "goes_with_before": tables[0][:6],
        "goes_with_after": tables[1][:6],
        "covariate": best,
        "covariate_values": [] if best is None else covariates[best].tolist(),
    }


def _grid(view: View, count: int) -> FloatArray:
    """Return the residual as frames × (markers · 3) with the mean of each marker taken off; 0 where a marker is hidden."""
    scene = view.trial.scene
    grid = np.full((len(scene.frames), count, 3), np.nan)
    grid[np.searchsorted(scene.frames, scene.frame), scene.marker] = view.vectors
    seen = np.isfinite(grid)
    mean = np.where(seen, grid, 0.0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    return np.where(seen, grid - mean, 0.0).reshape(len(grid), -1)


def _tip(data: Data, old: list[View], new: list[View]) -> dict[str, Any]:
    """Return the way of the marker farthest from the clamp along its main direction of motion: measured, before and after.

    Measured points are where the handed-back calibration puts them; a model stands at measured − residual. Clouds do not tell where a
    point of the surface went: {}.
    """
    if any(v.trial.scene.crossings is not None for v in old):
        return {}
    seen = set.intersection(*({int(m) for m in v.trial.scene.marker} for v in old))
    if not seen:
        return {}
    far = np.linalg.norm(data.robot.marker_points - data.robot.body.clamp_center, axis=1)
    tip = max(seen, key=lambda m: float(far[m]))
    parts = [(v, w, np.flatnonzero(v.trial.scene.marker == tip)) for v, w in zip(old, new)]
    measured = [w.measured[rows] for _, w, rows in parts]
    middle = np.vstack(measured).mean(axis=0)
    axis = np.linalg.svd(np.vstack(measured) - middle, full_matrices=False)[2][0]
    axis = axis if axis[np.abs(axis).argmax()] > 0 else -axis
    table: dict[str, list[Any]] = {name: [] for name in ("recording", "frame", "measured_m", "before_m", "after_m")}
    for (v, w, rows), points in zip(parts, measured):
        table["recording"] += [v.recording] * len(rows)
        table["frame"] += [v.number(int(k)) for k in v.trial.scene.frame[rows]]
        way = (points - middle) @ axis
        table["measured_m"] += way.tolist()
        table["before_m"] += (way - v.jet.residual[rows] @ axis).tolist()
        table["after_m"] += (way - w.jet.residual[rows] @ axis).tolist()
    return {"marker": data.robot.marker_names[tip], "direction": axis.tolist(), **table}


def _pictures(data: Data, old: list[View], new: list[View]) -> dict[str, Any]:
    """Return the skin of the declared body in three frames with the residuals there, and which way the cameras look."""
    view, other = old[0], new[0]
    mesh = to_linear(view.robot.body.mesh)
    triangles = surface_triangles(mesh)
    corners, triangles = np.unique(triangles, return_inverse=True)
    names = [data.robot.marker_names[m] for m in range(len(data.robot.marker_names))]
    frames = []
    for title, k in chosen_frames(view):
        rows, place = view.rows(k), view.trial.scene.marker[view.rows(k)]
        state = view.jet.states[k].positions
        frames.append(
            {
                "title": title,
                "recording": view.recording,
                "frame": view.number(k),
                "marker": [names[m] for m in place],
                "measured_m": other.measured[rows].tolist(),
                "before_m": view.vectors[rows].tolist(),
                "after_m": other.vectors[rows].tolist(),
                "nodes_m": np.round(state[corners], 6).tolist() if len(corners) <= MOST_NODES else None,
            }
        )
    small = len(corners) <= MOST_NODES
    cameras = [{"axis": T[:3, 2].tolist(), "position_m": T[:3, 3].tolist()} for T in other.poses]
    return {"triangles": triangles.reshape(-1, 3).tolist() if small else None, "frames": frames, "cameras": cameras}


# Candidates


def _ranking(data: Data, fit: JointFit, first: list[Candidate], rng: np.random.Generator) -> dict[str, dict[str, Any]]:
    """Return for each effect the linear estimate of its parameters with their plausible range, and how often it comes first."""
    ones = one_each(first)
    often = _first_share(data, fit, ones, rng)
    return {
        c.effect.name: {"parameters": _estimates(c), "first_share": None if often is None else often[i]}
        for i, c in enumerate(ones)
    }


def _estimates(c: Candidate) -> list[dict[str, Any]]:
    scale = np.maximum(np.linalg.norm(c.columns, axis=0), 1e-300)
    spread = np.sqrt(np.maximum(np.diag(np.linalg.pinv((c.columns / scale).T @ (c.columns / scale))), 0.0)) / scale
    if c.effect.discrete:
        return [
            {"label": p.label, "value": None, "std": None, "ends": _ends(p.value(p.low), p.value(p.high)), "unit": p.unit}
            for p in c.parameters
        ]
    rows = []
    for p, step, std in zip(c.parameters, c.step, spread):
        at = p.null + float(step)
        rows.append(
            {
                "label": p.label,
                "value": p.value(at),
                "std": p.value_std(at, float(std)),
                "ends": _ends(p.value(p.low), p.value(p.high)),
                "unit": p.unit,
            }
        )
    return rows


def _ends(a: float, b: float) -> list[float]:
    return [min(a, b), max(a, b)]


def _first_share(data: Data, fit: JointFit, ones: list[Candidate], rng: np.random.Generator) -> list[float] | None:
    """Return how often each effect has the best linear score when whole sweeps are drawn with replacement; None for few sweeps.

    Nuisance is projected out anew in each draw. Rows that belong to no sweep (seats, declared poses, priors) stay.
    """
    groups = sweep_rows(data.train, fit)
    if len(groups) < FEW_SWEEPS or not ones:
        return None
    J = np.asarray(fit.fit.jacobian)
    whole = np.hstack([J, *(c.columns for c in ones), fit.fit.residual[:, None]])
    size = np.maximum(np.linalg.norm(whole, axis=0), 1e-300)
    size[-1] = 1.0
    whole = whole / size
    inside = np.zeros(len(whole), dtype=bool)
    grams = []
    for rows in groups:
        inside[rows] = True
        grams.append(whole[rows].T @ whole[rows])
    rest = whole[~inside].T @ whole[~inside]
    spans = list(pairwise(np.cumsum([J.shape[1], *(c.columns.shape[1] for c in ones)])))
    wins = np.zeros(len(ones))
    for _ in range(DRAWS):
        counts = np.bincount(rng.integers(0, len(groups), len(groups)), minlength=len(groups))
        G = _without(rest + np.tensordot(counts, np.array(grams), axes=1), J.shape[1])
        gains = [_gain(G, a - J.shape[1], b - J.shape[1], c, size[a:b]) - c.cost for (a, b), c in zip(spans, ones)]
        wins[int(np.argmax(gains))] += max(gains) > 0
    return [float(w) / DRAWS for w in wins]


def _without(gram: FloatArray, p: int) -> FloatArray:
    """Return a Gram matrix with its first p columns projected out."""
    A, B, D = gram[:p, :p], gram[:p, p:], gram[p:, p:]
    return np.asarray(D - B.T @ np.linalg.pinv(A, rcond=1e-12, hermitian=True) @ B)


def _gain(G: FloatArray, a: int, b: int, c: Candidate, size: FloatArray) -> float:
    """Return by how much columns a … b lower the sum of squares of the last one; a single parameter stays within its bounds."""
    if c.effect.discrete:
        return float(-2.0 * size[0] * G[a, -1] - size[0] ** 2 * G[a, a])
    if G[a:b, a:b].trace() <= 0:
        return 0.0
    step = -np.linalg.pinv(G[a:b, a:b], rcond=1e-10, hermitian=True) @ G[a:b, -1]
    if b - a == 1:
        p = c.parameters[0]
        step = np.clip(step, (p.low - p.null) * size, (p.high - p.null) * size)
    return float(-2.0 * step @ G[a:b, -1] - step @ G[a:b, a:b] @ step)


def _confounding(first: list[Candidate]) -> dict[str, Any]:
    """Return how much of each effect's field (row) another one (column) imitates once nuisance is projected out."""
    shown = [c for c in one_each(first) if c.retained >= TESTABLE and c.columns.shape[1] <= WIDE][:MAP]
    bases = [np.linalg.qr(c.columns / np.maximum(np.linalg.norm(c.columns, axis=0), 1e-300))[0] for c in shown]
    fields = [c.columns @ c.step if np.linalg.norm(c.columns @ c.step) > 0 else c.columns[:, 0] for c in shown]
    share = [[float(np.linalg.norm(Q.T @ f) / max(float(np.linalg.norm(f)), 1e-300)) for Q in bases] for f in fields]
    return {"names": [c.effect.name for c in shown], "share": share}


def _power(last: list[Candidate]) -> dict[str, list[dict[str, Any]]]:
    """Return the smallest change of each parameter of each effect that would have been seen, in its own unit."""
    result: dict[str, list[dict[str, Any]]] = {}
    for c in one_each(last):
        if c.effect.discrete:
            whole = float(c.smallest[0]) if len(c.smallest) else None
            result[c.effect.name] = [{"label": "", "kind": "whole", "size": whole, "unit": "1"}]
            continue
        result[c.effect.name] = [
            {"label": p.label, "kind": KINDS[p.scale], "size": own_size(float(size), p.scale), "unit": p.unit}
            for p, size in zip(c.parameters, c.smallest)
        ]
    return result


KINDS = {"linear": "change", "log": "factor", "reciprocal": "softer_than"}
"""What the size of a parameter is, by how its coordinate gives its value."""


def own_size(size: float, scale: str) -> float | None:
    """Return a size in a coordinate as a change of the value, a factor on it, or the stiffness below which it is; None where it cannot be seen."""
    if not np.isfinite(size) or size <= 0:
        return None
    if scale == "log":
        return float(np.exp(size)) if size < 50.0 else None
    return 1.0 / size if scale == "reciprocal" else size


# Calibration, tests and card


def _calibration(data: Data, models: dict[str, FittedModel]) -> dict[str, Any]:
    """Return poses, initial inputs, modulus and zeros of each stage; poses as they moved from the first of them."""
    zero = models["before"].fit.fit.theta
    poses, inputs, terms = [], [], []
    at = 0
    for i, trial in enumerate(data.train[j] for j in heads_of(data.train)):
        for v in range(len(trial.poses)):
            part = slice(at + 6 * v, at + 6 * v + 6)
            moved = {name: (s.fit.fit.theta[part] - zero[part]).tolist() for name, s in models.items() if name != "before"}
            spread = {name: _deviations(s.fit, part) for name, s in models.items()}
            poses.append(
                {
                    "recording": i,
                    "camera": v,
                    "turn_rad": {n: m[:3] for n, m in moved.items()},
                    "shift_m": {n: m[3:] for n, m in moved.items()},
                    "turn_std_rad": {n: d[:3] for n, d in spread.items()},
                    "shift_std_m": {n: d[3:] for n, d in spread.items()},
                }
            )
        for j, cable in enumerate(data.robot.body.cable_names if trial.initial is not None else ()):
            one = at + 6 * len(trial.poses) + j
            values = {
                name: [float(s.fit.fit.theta[one]), _deviations(s.fit, slice(one, one + 1))[0]] for name, s in models.items()
            }
            inputs.append({"recording": i, "cable": cable, "unit": "N" if data.control == "tension" else "m", "values": values})
        at += trial.size
    labels = dict[str, Any]()
    for name, fitted in models.items():
        for label, entry in _nuisance(fitted.fit).items():
            labels.setdefault(label, {"unit": entry["unit"], "declared": entry["declared"], "values": {}})["values"][name] = (
                entry["value"]
            )
    terms = [{"label": label, **entry} for label, entry in labels.items()]
    return {"poses": poses, "initial_inputs": inputs, "parameters": terms}


def _deviations(fit: JointFit, part: slice) -> list[float]:
    return [float(v) for v in np.sqrt(np.maximum(np.diag(fit.fit.covariance)[part], 0.0))]


def _nuisance(fit: JointFit) -> dict[str, dict[str, Any]]:
    result, at = dict[str, dict[str, Any]](), 0
    for effect, _, parameters in fit.hypothesis.terms:
        for p in parameters:
            value, std = float(fit.coordinates[at]), float(fit.std[at])
            at += 1
            if effect.name in NUISANCE:
                result[f"{effect.name}: {p.label}"] = {
                    "unit": p.unit,
                    "declared": p.value(p.null),
                    "value": [p.value(value), p.value_std(value, std)],
                }
    return result


def _tests(trials: list[Trial], residuals: list[FloatArray], fit: JointFit, structure: StructureTests) -> dict[str, Any]:
    return {
        "structure": structure.document(),
        "lack_of_fit": lack_of_fit(trials, residuals, len(fit.fit.theta)),
        "train_rms_m": fit.rms,
    }


def lack_of_fit(trials: list[Trial], residuals: list[FloatArray], parameters: int) -> dict[str, Any] | None:
    """Return the F test of lack of fit against pure error; None where too little is repeated.

    A repeat is a state that is reached again from the same state before it; frames of one stay in a state are averaged first, since
    they share their error. F = [Σ n c̄² / (cells − parameters)] / [Σ (c − c̄)² / (stays − cells)] over the cells (state, marker).
    """
    from scipy.stats import f as fisher

    lack, pure, cells, stays = 0.0, 0.0, 0, 0
    for trial, residual in zip(trials, residuals):
        for values in _cells(trial, residual):
            mean = values.mean(axis=0)
            lack += len(values) * float(mean @ mean)
            pure += float(((values - mean) ** 2).sum())
            cells, stays = cells + len(mean), stays + len(mean) * len(values)
    own, free = cells - parameters, stays - cells
    if free < REPEATS or own < 1 or pure <= 0:
        return None
    ratio = (lack / own) / (pure / free)
    return {
        "f": ratio,
        "p_value": float(fisher.sf(ratio, own, free)),
        "df_lack": own,
        "df_pure": free,
        "pure_error_m": float(np.sqrt(max(r.shape[1] for r in residuals) * pure / free)),
    }


def _stays(trial: Trial) -> dict[int, tuple[int, tuple[bytes, bytes]]]:
    """Return for each frame the number of its stay, and what tells states apart: the state and the one before it."""
    recording = trial.scene.recording
    keys = [state_key(recording, k) for k in range(len(recording.time_s))]
    result, stay, past = {}, 0, b""
    for k, key in enumerate(keys):
        if k > 0 and key != keys[k - 1]:
            stay, past = stay + 1, keys[k - 1]
        result[k] = (stay, (key, past))
    return result


def _cells(trial: Trial, residual: FloatArray) -> list[FloatArray]:
    """Return for each state and marker the mean residuals of its stays [m], (n, c)."""
    stays = _stays(trial)
    sums: dict[tuple[tuple[bytes, bytes], int], dict[int, list[FloatArray]]] = {}
    for k, m, r in zip(trial.scene.frame, trial.scene.marker, residual):
        stay, state = stays[int(k)]
        sums.setdefault((state, int(m)), {}).setdefault(stay, []).append(r)
    return [np.array([np.mean(rows, axis=0) for rows in cell.values()]) for cell in sums.values()]


def _repeats(trial: Trial) -> int:
    """Return how many stays repeat an earlier one."""
    stays = _stays(trial)
    seen = {stays[int(k)] for k in trial.scene.frames}
    return len(seen) - len({state for _, state in seen})


def _excluded(recording: Recording, data: Data) -> dict[str, list[int]]:
    """Return the frames of a recording that are neither fitted nor held out, by reason."""
    used = {int(k) for t in [*data.train, *data.held] if t.scene.recording is recording for k in t.scene.frames}
    usable, marked = set(usable_frames(recording).tolist()), set(recording.marker_frame.tolist())
    if "clouds" in data.measured:
        marked |= set(cloud_frames(recording).tolist())
    reasons: dict[str, list[int]] = {}
    for k in range(len(recording.time_s)):
        if k in used:
            continue
        why = "touched, load not declared" if k not in usable else "no markers" if k not in marked else "thinned out"
        reasons.setdefault(why, []).append(int(recording.frame_numbers[k]))
    return reasons
