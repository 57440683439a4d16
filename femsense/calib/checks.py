"""Whether measured markers can be those of the robot: unit, handedness, swapped labels, outliers.

Each alternative reading of the same numbers (a scale, a mirror image, a swap) is fitted to the model. It is reported if it removes most
of the residual.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.core.errors import DataError
from femsense.model.camera_frame import in_robot_frame
from femsense.model.marker_units import unit_hint
from femsense.model.observation import Scene
from femsense.model.recording import Recording, with_marker_table
from femsense.model.robot import Robot

SUSPICIOUS = 0.02
"""A residual below this share of the markers' spread needs no alternative reading. The value was chosen, not calibrated: recordings of
the rig have smaller residuals, and a real tendon robot with an incomplete model 0.03 to 0.26; there alternatives are tried and do not fit
better."""
EXPLAINED = 4.0
"""Another reading counts where the residual falls by this factor."""
HOPELESS = 0.5
"""A residual above this share of the markers' spread is no fit, whatever the reason."""
OUTLIER = 0.1
"""An outlier is off by this share of the markers' spread at least. No measurement set it; on a real tendon robot one marker was
named for it, which may be the model's error."""
LEFT_HANDED = "Mirrored they fit: are the axes left-handed? Camera frames are right-handed (x right, y down, z forward): change the sign of one axis"
UNNAMED = "Where names are not known, leave the column marker empty: the model names the markers"


@dataclass(frozen=True, eq=False, slots=True)
class Pairs:
    """Where the model has markers and where they were measured, both in the robot frame."""

    modelled: FloatArray
    """[m], shape (k, 3)."""
    measured: FloatArray
    """[m], shape (k, 3)."""
    marker: IntArray
    """shape (k,)."""
    group: IntArray
    """Frame of each row, an index 0 … F − 1, shape (k,)."""

    @property
    def spread(self) -> float:
        """Root mean square distance of the modelled markers from their middle [m]."""
        return float(np.sqrt(((self.modelled - self.modelled.mean(axis=0)) ** 2).sum(axis=1).mean()))


def similarity(a: FloatArray, b: FloatArray, *, mirrored: bool = False) -> tuple[float, FloatArray]:
    """Return the scale of b against a, and the residual [m], shape (k, 3), of the best turned,
    shifted and scaled b (Umeyama 1991).

    Arguments:
        a, b: corresponding points [m], shape (k, 3).
        mirrored: mirror b first.
    """
    p, q = a - a.mean(axis=0), (b - b.mean(axis=0)) * ([-1.0, 1.0, 1.0] if mirrored else [1.0, 1.0, 1.0])
    U, values, Vt = np.linalg.svd(p.T @ q)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    scale = float((values * sign).sum() / max((q**2).sum(), 1e-300))
    return 1.0 / max(scale, 1e-12), p - scale * q @ (U * sign @ Vt).T


def rigid_rms(a: FloatArray, b: FloatArray, *, mirrored: bool = False, scale: float = 1.0) -> float:
    """Return the rms residual [m] of the best rotation and translation of b / scale onto a."""
    p, q = a - a.mean(axis=0), (b - b.mean(axis=0)) / scale * ([-1.0, 1.0, 1.0] if mirrored else [1.0, 1.0, 1.0])
    U, _, Vt = np.linalg.svd(p.T @ q)
    R = U * [1.0, 1.0, np.sign(np.linalg.det(U @ Vt))] @ Vt
    return float(np.sqrt(((p - q @ R.T) ** 2).sum(axis=1).mean()))


def pairs_of(robot: Robot, scene: Scene, poses: Sequence[FloatArray], residual: FloatArray) -> list[Pairs]:
    """Return modelled and measured markers of each camera; the residual [m], shape (k, 3), is measured − modelled."""
    measured = in_robot_frame(scene.points, scene.view, poses, robot.observation)
    views = [scene.view == v for v in range(len(poses))]
    return [Pairs(measured[m] - residual[m], measured[m], scene.marker[m], scene.frame[m]) for m in views]


def check_reading(robot: Robot, pairs: Sequence[Pairs], *, cameras: Sequence[str] = ("",), strict: bool = True) -> None:
    """Refuse markers that are in another unit, mirrored, or have swapped labels in all frames.

    Arguments:
        robot: for the names of its markers.
        pairs: the markers of each camera.
        cameras: their names.
        strict: also refuse markers that do not fit for an unknown reason.

    Raises:
        DataError: says what was found and what it looks like.
    """
    for one, camera in zip(pairs, cameras):
        which = f" of camera {camera}" if len(pairs) > 1 else ""
        if len(np.unique(one.marker)) < 4 or one.spread <= 0:
            continue
        plain = rigid_rms(one.modelled, one.measured)
        if strict:
            _check_shift(one, plain, which)
        if plain < SUSPICIOUS * one.spread:
            continue
        found = (
            f"the markers{which} do not fit the robot: the residual is {100 * plain / one.spread:.0f} % of their spread of "
            f"{1e3 * one.spread:.3g} mm"
        )
        most_fit = float(np.median(np.linalg.norm(one.measured - one.modelled, axis=1))) < SUSPICIOUS * one.spread
        scale, _ = similarity(one.modelled, one.measured)
        if (
            not most_fit
            and max(scale, 1 / scale) > 1.5
            and rigid_rms(one.modelled, one.measured, scale=scale) * EXPLAINED < plain
        ):
            raise DataError(f"{found}. They are {scale:.4g} times too large: {unit_hint(scale)} The files hold metres")
        if not most_fit and rigid_rms(one.modelled, one.measured, mirrored=True) * EXPLAINED < plain:
            raise DataError(f"{found}. {LEFT_HANDED}")
        swapped = _swapped(one, plain)
        if swapped:
            alike = [name for name, p in zip(cameras, pairs) if _swapped(p, rigid_rms(p.modelled, p.measured)) == swapped]
            rows = f", in the rows of camera {' and '.join(alike)}" if which else ""
            raise DataError(
                f"{found}. The labels seem swapped: {_cycles(robot, swapped)}. Swap them in markers.csv{rows}. {UNNAMED}"
            )
        if strict and plain > HOPELESS * one.spread:
            raise DataError(f"{found}. Are these the markers of {robot.name!r}, in metres, under their names? {UNNAMED}")


def _check_shift(pairs: Pairs, plain: float, which: str) -> None:
    """Refuse markers that another pose would fit, while the fitted one leaves a multiple of their spread: other rows hold it elsewhere.

    Raises:
        DataError: with the distance.
    """
    left = float(np.sqrt(((pairs.measured - pairs.modelled) ** 2).sum(axis=1).mean()))
    if left > pairs.spread and left > EXPLAINED * plain:
        raise DataError(
            f"the markers{which} of the frames lie {1e3 * left:.3g} mm from the robot at the fitted pose, and {1e3 * plain:.3g} mm from "
            "it at one of their own: rest.csv, or a declared pose, puts the robot elsewhere than the frames. Are both in the frame of "
            "the same camera, which did not move in between?"
        )


def _swapped(pairs: Pairs, plain: float) -> dict[int, int]:
    """Return which marker each named one is, where other names take most of the residual away; empty where none do.

    In the frame with most markers three of them, far apart, are tried as every three of the model that are as far apart;
    the other names follow by assignment (Kuhn 1955).
    """
    numbers, counts = np.unique(pairs.group, return_counts=True)
    mine = pairs.group == numbers[counts.argmax()]
    named, model, seen = pairs.marker[mine], pairs.modelled[mine], pairs.measured[mine]
    best, names = np.inf, np.arange(len(named))
    corners = _far_apart(seen)
    for triple in _alike(model, seen[corners], 0.15 * pairs.spread):
        placed = _moved(seen, seen[corners], model[list(triple)])
        squares = ((placed[:, None] - model[None]) ** 2).sum(axis=2)
        columns = linear_sum_assignment(squares)[1]
        left = float(squares[np.arange(len(seen)), columns].sum())
        best, names = (left, columns) if left < best else (best, names)
    truth = {int(a): int(b) for a, b in zip(named, named[names])}
    renamed = np.array([truth.get(int(m), int(m)) for m in pairs.marker])
    explained = rigid_rms(_modelled(pairs, renamed), pairs.measured) * EXPLAINED < plain
    return {a: b for a, b in truth.items() if a != b} if explained else {}


def _far_apart(points: FloatArray) -> IntArray:
    """Return three of the points (k, 3) that span a wide triangle."""
    first = int(((points - points.mean(axis=0)) ** 2).sum(axis=1).argmax())
    second = int(((points - points[first]) ** 2).sum(axis=1).argmax())
    area = np.linalg.norm(np.cross(points - points[first], points[second] - points[first]), axis=1)
    return np.array([first, second, int(area.argmax())])


def _alike(model: FloatArray, triangle: FloatArray, tolerance: float) -> Iterator[tuple[int, int, int]]:
    """Yield the threes of model points (k, 3) whose distances are those of a triangle (3, 3), up to a tolerance [m]."""
    distance = np.linalg.norm(model[:, None] - model[None], axis=2)
    ab, ac, bc = (float(np.linalg.norm(triangle[i] - triangle[j])) for i, j in ((0, 1), (0, 2), (1, 2)))
    for i, j in np.argwhere(np.abs(distance - ab) < tolerance).tolist():
        third = (np.abs(distance[i] - ac) < tolerance) & (np.abs(distance[j] - bc) < tolerance)
        third[[i, j]] = False
        yield from ((i, j, k) for k in np.flatnonzero(third).tolist())


def _moved(points: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Return points (k, 3), turned and shifted as takes a to b, both (3, 3), best."""
    U, _, Vt = np.linalg.svd((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))
    R = U * [1.0, 1.0, np.sign(np.linalg.det(U @ Vt))] @ Vt
    return np.asarray((points - a.mean(axis=0)) @ R.T + b.mean(axis=0))


def _cycles(robot: Robot, truth: dict[int, int]) -> str:
    """Return swaps as text: "a and b" for two, "a is b, b is c, c is a" for more."""
    left, texts = dict(truth), []
    while left:
        chain = [next(iter(left))]
        while left.get(chain[-1], chain[0]) != chain[0]:
            chain.append(left[chain[-1]])
        names = [robot.marker_names[m] for m in chain]
        texts.append(
            " and ".join(names) if len(names) == 2 else ", ".join(f"{a} is {b}" for a, b in zip(names, [*names[1:], names[0]]))
        )
        for m in chain:
            left.pop(m, None)
    return "; ".join(texts)


def _modelled(pairs: Pairs, named: IntArray) -> FloatArray:
    """Return where the model has the markers under other names; one that its frame lacks is where it is on average."""
    there = {(int(g), int(m)): place for g, m, place in zip(pairs.group, pairs.marker, pairs.modelled)}
    average = {int(m): pairs.modelled[pairs.marker == m].mean(axis=0) for m in np.unique(pairs.marker)}
    return np.array([there.get((int(g), int(m)), average[int(m)]) for g, m in zip(pairs.group, named)])


def true_labels(places: FloatArray, measured: FloatArray, marker: IntArray, *, noise: float) -> IntArray:
    """Return which marker each measured point is: as named, or swapped where the names cannot be right.

    The assignment with the least sum of squared distances (Kuhn 1955) counts where it takes EXPLAINED of the distance away of
    those that it renames, and that distance was far above the noise.

    Arguments:
        places: where the model has all markers [m], shape (m, 3).
        measured: one frame of one camera [m], same frame, shape (k, 3).
        marker: as named, shape (k,).
        noise: one standard deviation of a marker along an axis [m].
    """
    if len(marker) < 2:
        return marker
    squares = ((measured[:, None] - places[None]) ** 2).sum(axis=2)
    rows, columns = linear_sum_assignment(squares)
    best = marker.copy()
    best[rows] = columns
    changed = best != marker
    if not changed.any() or len(np.unique(best)) < len(best):
        return marker
    before = np.sqrt(squares[changed, marker[changed]].mean())
    after = np.sqrt(squares[changed, best[changed]].mean())
    return best if after * EXPLAINED < before and before > 10.0 * noise else marker


def relabelled(
    robot: Robot, scene: Scene, pairs: Sequence[Pairs], noise: float, *, strict: bool = True
) -> tuple[Recording, bool]:
    """Return the recording with swapped labels corrected and outliers removed in the scene's frames, each listed in a warning.

    Arguments:
        robot: the robot.
        scene: the markers that were fitted.
        pairs: their places, one item a camera, rows in the order of the scene's.
        noise: rms residual of the fit along one axis [m].
        strict: refuse labels that are swapped in most frames, but not in all.

    Returns:
        the recording, and whether anything changed.

    Raises:
        DataError: labels that seem swapped in most frames: the correct ones cannot be identified.
    """
    marker, far = scene.marker.copy(), np.zeros(len(scene.marker), dtype=np.bool_)
    for view, one in enumerate(pairs):
        rows = np.flatnonzero(scene.view == view)
        for group in np.unique(one.group):
            mine = one.group == group
            marker[rows[mine]] = true_labels(_all_places(robot, one, mine), one.measured[mine], one.marker[mine], noise=noise)
            far[rows[mine]] = _outliers(np.linalg.norm(one.measured[mine] - one.modelled[mine], axis=1), one.spread)
    renamed = marker != scene.marker
    swapped = len(np.unique(scene.frame[renamed]))
    if swapped > 0.5 * len(scene.frames):  # a swap in all frames is one of the whole recording
        if strict and swapped < len(scene.frames):
            names = " and ".join(robot.marker_names[m] for m in np.unique(scene.marker[renamed]))
            raise DataError(
                f"the labels of {names} seem swapped in {swapped} of {len(scene.frames)} frames. Make them the same in all frames of markers.csv. {UNNAMED}"
            )
        return scene.recording, False
    far &= ~renamed & ~_mostly(far, scene.marker)
    if not (far | renamed).any():
        return scene.recording, False
    _say(robot, scene, renamed, far)
    return _rewritten(robot, scene, marker, ~far), True


def _mostly(far: BoolArray, marker: IntArray) -> BoolArray:
    """Return which rows are of a marker that is far in most frames, shape (k,): it sits elsewhere than declared,
    which is no outlier."""
    total = np.bincount(marker, minlength=int(marker.max(initial=0)) + 1)
    return np.asarray((np.bincount(marker[far], minlength=len(total)) > 0.5 * total)[marker])


def _say(robot: Robot, scene: Scene, renamed: BoolArray, far: BoolArray) -> None:
    """Warn of corrected labels and removed outliers, frame by frame."""
    texts = []
    for k in np.unique(scene.frame[renamed | far]):
        parts = []
        for rows, what in ((renamed, "labels were swapped, and are corrected"), (far, "outliers, left out")):
            names = ", ".join(robot.marker_names[m] for m in scene.marker[rows & (scene.frame == k)])
            parts += [f"{names} ({what})"] if names else []
        texts.append(f"frame {int(scene.recording.frame_numbers[k])}: {', '.join(parts)}")
    text = "; ".join(texts[:6]) + (f"; and {len(texts) - 6} frames more" if len(texts) > 6 else "")
    warnings.warn(f"{scene.recording.folder or 'the recording'}: {text}", stacklevel=5)


def _all_places(robot: Robot, pairs: Pairs, mine: BoolArray) -> FloatArray:
    """Return the model positions of all markers in a frame; those that no camera sees are placed far away."""
    places = np.full((len(robot.marker_names), 3), 1e3)
    places[pairs.marker[mine]] = pairs.modelled[mine]
    return places


def _outliers(off: FloatArray, spread: float) -> BoolArray:
    """Return which markers of one frame, shape (k,), have a large residual [m] while most others have a small one.

    In the sorted residuals, outliers follow a jump by the factor EXPLAINED within the upper two fifths. Model errors grow along the body
    without such a jump.
    """
    order = np.argsort(off)
    first = max(int(np.ceil(0.6 * len(off))), 3)
    jumps = [i for i in range(first, len(off)) if off[order[i]] > max(EXPLAINED * off[order[i - 1]], OUTLIER * spread)]
    far = np.zeros(len(off), dtype=np.bool_)
    far[order[jumps[0] :] if jumps else []] = True
    return far


def _rewritten(robot: Robot, scene: Scene, marker: IntArray, kept: BoolArray) -> Recording:
    """Return the recording whose rows in the scene's frames have other names, or are gone."""
    r = scene.recording
    others = ~np.isin(r.marker_frame, scene.frames)
    number = {name: i for i, name in enumerate(robot.marker_names)}
    index = np.array([number[r.marker_names[i]] for i in r.marker_index], dtype=np.int64)
    return with_marker_table(
        replace(r, marker_names=robot.marker_names),
        robot.marker_names,
        np.concatenate([r.marker_frame[others], scene.frame[kept]]),
        np.concatenate([index[others], marker[kept]]),
        np.vstack([r.marker_xyz[others], scene.points[kept]]),
        view=np.concatenate([r.marker_view[others], scene.view[kept]]),
    )
