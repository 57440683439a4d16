"""Data for the figures of the report, so that loop.json alone suffices to draw them."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.fem.mesh import surface_triangles, to_linear
from femsense.loop.data.covariates import actuation_of, covariates_of, load_of, rank_with, stacked, unloading
from femsense.loop.data.dataset import Data
from femsense.loop.data.holdout import sweeps_of
from femsense.loop.data.repeats import count_repeats
from femsense.loop.data.trial import heads_of
from femsense.loop.fit.discretisation_error import without_mesh_error
from femsense.loop.fit.fitted_model import FittedModel
from femsense.loop.result.evidence import CameraPlace, Evidence, FrameTable, Pattern, Pictures, Snapshot, Tests, Tip
from femsense.loop.result.records import Structure
from femsense.loop.search.search_state import Search
from femsense.loop.verdict.calibration_tables import calibration_shift, excluded
from femsense.loop.verdict.candidate_tables import confounding_map, power, ranking
from femsense.loop.verdict.force_impact import View, chosen_frames, equivalent_forces, force_consequence, tuples_of, views_of
from femsense.loop.verdict.lack_of_fit import tested
from femsense.loop.verdict.residual_diagnostics import frame_rms, structure_tests

MOST_NODES = 4000
"""Largest number of corners of a surface that is drawn deformed."""


def gather(
    data: Data, search: Search, back: FittedModel, shown: FittedModel, after_tests: Structure, rng: np.random.Generator
) -> Evidence:
    """Return the data for the figures and tables of the report.

    Arguments:
        data: the recordings, split.
        search: its record.
        back: the returned model; `shown`: that or the last model of the search, whose residual is reported.
        after_tests: tests of structure of the reported residual.
        rng: random generator of the bootstrap and the permutations.
    """
    before, noise = search.before, search.noise
    old, new = views_of(data, before), views_of(data, back)
    score, pattern = _pattern(data, old, new)
    cleaned, left = (
        [without_mesh_error(t, j.residual, noise, nor_placements=True) for t, j in zip(data.train, s.fit.jets)]
        for s in (before, shown)
    )
    heads = [data.train[i] for i in heads_of(data.train)]
    return Evidence(
        frames=_frame_table(old, new, score),
        score=pattern,
        tip=_tip(data, old, new),
        pictures=_pictures(data, old, new),
        ranking=ranking(data, search.base.fit, search.first, rng),
        confounding=confounding_map(search.first, data.thresholds),
        calibration=calibration_shift(data, {"before": before, "nuisance": search.base, "after": search.final}),
        tests=Tests(
            before=tested(
                data.train, cleaned, before.fit, structure_tests(data.train, cleaned, rng=rng, level=data.thresholds.structure)
            ),
            after=tested(data.train, left, shown.fit, after_tests),
        ),
        power=power(search.last),
        excluded=tuple(excluded(trial.scene.recording, data) for trial in heads),
        repeats=sum(count_repeats(trial) for trial in heads),
        forces=force_consequence(old, new, noise),
        equivalent_forces=equivalent_forces([v for v in views_of(data, shown) if not v.held_out], noise),
    )


# Frames


def _label(view: View) -> list[str]:
    recording, frames = view.trial.scene.recording, view.trial.scene.frames
    every = sweeps_of(recording, np.arange(len(recording.time_s)))
    return [recording.sweep[k] if recording.sweep is not None else f"{every[k] + 1}" for k in frames]


def _frame_table(old: list[View], new: list[View], score: list[tuple[FloatArray, FloatArray]]) -> FrameTable:
    """Return one row per frame of all trials, fitted ones first."""
    parts = [_frame_columns(a, b, *scores) for a, b, scores in zip(old, new, score)]
    return FrameTable(**{f.name: tuple(v for part in parts for v in getattr(part, f.name)) for f in fields(FrameTable)})


def _frame_columns(before: View, after: View, first: FloatArray, second: FloatArray) -> FrameTable:
    """Return the rows of one trial."""
    recording, frames = before.trial.scene.recording, before.trial.scene.frames
    return FrameTable(
        recording=(before.recording,) * len(frames),
        frame=tuple(before.number(int(k)) for k in frames),
        time_s=tuple(recording.time_s[frames].tolist()),
        sweep=tuple(_label(before)),
        held_out=(before.held_out,) * len(frames),
        actuation=tuple(actuation_of(recording)[frames].tolist()),
        unloading=tuple(unloading(recording)[frames].tolist()),
        load_n=tuple(load_of(recording)[frames].tolist()),
        before_rms_m=tuple(frame_rms(before.trial, before.jet.residual).tolist()),
        after_rms_m=tuple(frame_rms(after.trial, after.jet.residual).tolist()),
        score_before_m=tuple(first.tolist()),
        score_after_m=tuple(second.tolist()),
    )


def _pattern(data: Data, old: list[View], new: list[View]) -> tuple[list[tuple[FloatArray, FloatArray]], Pattern]:
    """Return the amplitude of the leading pattern of the residual before, by frame, (before, after) per trial [m], and its correlations.

    The pattern is the first right singular vector of frames × markers, after the mean of each marker over the frames of a trial is subtracted; an
    amplitude is the residual's component along it over √markers, comparable with a root mean square.
    """
    count = len(data.robot.marker_names)
    names = sorted({int(m) for v in old for m in v.trial.scene.marker})
    fields = [(_grid(a, count), _grid(b, count)) for a, b in zip(old, new)]
    _, s, Vt = np.linalg.svd(np.vstack([f for f, _ in fields]), full_matrices=False)
    shape = Vt[0] * (1.0 if Vt[0][np.abs(Vt[0]).argmax()] > 0 else -1.0)
    scores = [(f @ shape / np.sqrt(count), g @ shape / np.sqrt(count)) for f, g in fields]
    covariates = stacked([covariates_of(v.trial.scene) for v in old])
    tables = [rank_with(np.concatenate([pair[i] for pair in scores]), covariates) for i in (0, 1)]
    best = tables[0][0].covariate if tables[0] else None
    return scores, Pattern(
        share=float(s[0] ** 2 / max(float((s**2).sum()), 1e-300)),
        pattern={data.robot.marker_names[i]: tuple(shape.reshape(-1, 3)[i].tolist()) for i in names},
        goes_with_before=tuple(tables[0][:6]),
        goes_with_after=tuple(tables[1][:6]),
        covariate=best,
        covariate_values=() if best is None else tuple(covariates[best].tolist()),
    )


def _grid(view: View, count: int) -> FloatArray:
    """Return the residual as frames × (markers · 3) with the mean of each marker subtracted; 0 if a marker is hidden."""
    scene = view.trial.scene
    grid = np.full((len(scene.frames), count, 3), np.nan)
    grid[np.searchsorted(scene.frames, scene.frame), scene.marker] = view.vectors
    seen = np.isfinite(grid)
    mean = np.where(seen, grid, 0.0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    return np.where(seen, grid - mean, 0.0).reshape(len(grid), -1)


def _tip(data: Data, old: list[View], new: list[View]) -> Tip | None:
    """Return the path of the marker farthest from the clamp along its main direction of motion: measured, before and after.

    Measured points are placed by the returned calibration; a model's points are measured − residual. None for clouds, which do not identify
    material points.
    """
    if any(v.trial.scene.crossings is not None for v in old):
        return None
    seen = set.intersection(*({int(m) for m in v.trial.scene.marker} for v in old))
    if not seen:
        return None
    far = np.linalg.norm(data.robot.marker_points - data.robot.body.clamp_center, axis=1)
    tip = max(seen, key=lambda m: float(far[m]))
    parts = [(v, w, np.flatnonzero(v.trial.scene.marker == tip)) for v, w in zip(old, new)]
    measured = [w.measured[rows] for _, w, rows in parts]
    middle = np.vstack(measured).mean(axis=0)
    axis = np.linalg.svd(np.vstack(measured) - middle, full_matrices=False)[2][0]
    axis = axis if axis[np.abs(axis).argmax()] > 0 else -axis
    ways = [(points - middle) @ axis for points in measured]
    return Tip(
        marker=data.robot.marker_names[tip],
        direction=tuple(axis.tolist()),
        recording=tuple(v.recording for v, _, rows in parts for _ in rows),
        frame=tuple(v.number(int(k)) for v, _, rows in parts for k in v.trial.scene.frame[rows]),
        measured_m=tuple(np.concatenate(ways).tolist()),
        before_m=tuple(np.concatenate([way - v.jet.residual[rows] @ axis for way, (v, _, rows) in zip(ways, parts)]).tolist()),
        after_m=tuple(np.concatenate([way - w.jet.residual[rows] @ axis for way, (_, w, rows) in zip(ways, parts)]).tolist()),
    )


def _pictures(data: Data, old: list[View], new: list[View]) -> Pictures:
    """Return the surface of the declared body in three frames with the residuals there, and the viewing directions of the cameras."""
    view, other = old[0], new[0]
    triangles = surface_triangles(to_linear(view.robot.body.mesh))
    corners, triangles = np.unique(triangles, return_inverse=True)
    is_small = len(corners) <= MOST_NODES
    frames = []
    for title, k in chosen_frames(view):
        rows = view.rows(k)
        state = view.jet.states[k].positions
        frames.append(
            Snapshot(
                title=title,
                recording=view.recording,
                frame=view.number(k),
                marker=tuple(data.robot.marker_names[m] for m in view.trial.scene.marker[rows]),
                measured_m=tuples_of(other.measured[rows]),
                before_m=tuples_of(view.vectors[rows]),
                after_m=tuples_of(other.vectors[rows]),
                nodes_m=tuples_of(np.round(state[corners], 6)) if is_small else None,
            )
        )
    cameras = tuple(CameraPlace(tuple(T[:3, 2].tolist()), tuple(T[:3, 3].tolist())) for T in other.poses)
    faces = tuple(tuple(face) for face in triangles.reshape(-1, 3).tolist()) if is_small else None
    return Pictures(faces, tuple(frames), cameras)
