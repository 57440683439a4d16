"""What moves the rows beside contact forces: pose, modulus, and errors that neighbours share; and what free frames teach of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from femsense.core.arrays import FloatArray, freeze
from femsense.fem.assembly import internal
from femsense.fem.compliance import Tangent, drive_rows
from femsense.fem.equilibrium import Equilibrium
from femsense.model.camera import CameraNoise
from femsense.model.robot import spread_points
from femsense.sensing.types import Knowledge, Rows, Sensor

CENTRES = 24
"""Centres of the field of shared errors: as many degrees of freedom as its error may have along the body."""
HUBER = 2.5
"""Whitened residuals beyond this count linearly."""
CELL = 0.5
"""Points within this share of the length of shared errors may err together."""
OUTLIER = 5.0
"""Where a frame is judged, whitened residuals beyond this count as this."""
BIAS_STEPS = np.concatenate([[0.0], 1e-5 * 2.0 ** np.arange(9)])
SHARE_STEPS = np.concatenate([[0.0], 0.00125 * 2.0 ** np.arange(7)])
"""Sizes of the shared errors that are tried: 0.01 … 2.6 mm, and 0.1 … 8 % of the way."""
FAR_OFF = 9.0
"""Misfit per row that says that a frame is not explained where no free frame tells more: three standard deviations everywhere."""
DRIVE_STD = 0.05
"""What is not known beforehand of the pull of a cable or the pressure of a chamber, relative: motor gain, and how far its ends sink into the mesh."""
APART = 2.0
"""The pose of the calibration knew neither modulus nor pulls: its standard deviations count so much larger where free
frames tell all of them."""
LIKELY_GAIN = 13.5
"""Log-evidence gain that noise alone gives once in 1000 frames: χ² with three degrees at some 50 places that differ."""


def first_knowledge(
    noises: tuple[CameraNoise, ...],
    surface_nodes: FloatArray,
    size: float,
    modulus_std: float,
    pose_covariance: FloatArray,
    *,
    drives: int = 0,
) -> Knowledge:
    """Return what is known before a free frame is seen.

    Arguments:
        noises: of each camera.
        surface_nodes: nodes of the surface at rest [m], shape (s, 3).
        size: diagonal of the body [m].
        modulus_std: relative.
        pose_covariance: of all cameras' (rotation, shift), shape (6 v, 6 v).
        drives: cables and chambers.
    """
    centres = surface_nodes[spread_points(surface_nodes, CENTRES)]
    v = len(pose_covariance)
    root = np.diag(np.concatenate([np.zeros(v), [modulus_std], np.full(drives, DRIVE_STD)]))
    root[:v, :v] = _root(pose_covariance)
    return Knowledge(
        noises=noises,
        centres=freeze(centres),
        length=0.7 * _spacing(centres, size),
        bias_m=1e-4,
        model_share=0.01,
        common_mean=freeze(np.zeros(v + 1 + drives)),
        common_root=freeze(root),
        gain_limit=LIKELY_GAIN,
        misfit_limit=FAR_OFF,
    )


def sag_at(sensor: Sensor, state: Equilibrium, tangent: Tangent) -> FloatArray:
    """Return how the nodes move when the body becomes so much softer, and when each cable or chamber pulls so much harder.

    Per relative change [m], shape (1 + a + c, n, 3), or (1, n, 3) where pulls are not asked for. A held cable pulls harder by what shortens it.
    """
    body, n = sensor.robot.body, len(state.positions)
    load = internal(body, state.positions, tangent=False).forces
    pulls = np.array([*state.tension.values(), *state.pressure.values()])
    if not pulls_of(sensor):
        return np.asarray(tangent.respond(load[None]))
    shares = [t / T if T > 0 else np.ones_like(t) for t, T in zip(state.segment_tensions, state.tension.values())]
    rows = pulls[:, None, None] * drive_rows(body, state.positions, shares).reshape(len(pulls), n, 3)
    moves = tangent.respond(np.concatenate([load[None], rows]))
    held = np.flatnonzero(state.held)
    if len(held):
        by_length = tangent.respond_to_held()
        moves[1 + held] = (pulls[held] * np.diag(tangent.held_compliance))[:, None, None] * by_length
    return np.asarray(moves)


def pulls_of(sensor: Sensor) -> int:
    """Return how many pulls of cables and chambers the free frames were asked for."""
    return len(sensor.knowledge.common_mean) - 6 * len(sensor.calibration.poses) - 1


def nuisance_columns(knowledge: Knowledge, rows: Rows, sag: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the columns of unit nuisance (r, q) [m] and what the free frames say that they add to the residual (r,) [m]."""
    common = common_columns(rows, sag)
    field = _kernel(knowledge, rows.place)
    own = [common @ knowledge.common_root]
    own += [knowledge.bias_m * field] if knowledge.bias_m > 0 else []
    own += [knowledge.model_share * rows.way[:, None] * field] if knowledge.model_share > 0 else []
    return np.hstack(own), common @ knowledge.common_mean


def common_columns(rows: Rows, sag: FloatArray) -> FloatArray:
    """Return how the residual changes with pose steps, the modulus and the pulls, shape (r, 6 v + 1 + a + c)."""
    return np.hstack([rows.by_pose, rows.functional(sag)])


def response_std(knowledge: Knowledge, drives: int) -> float:
    """Return how far the model's answer to a force may be off beside its answer to gravity, relative [1].

    Cables pull as declared, but the model needs other pulls to move as the body does (mesh, law, ties): what it needs of a cable, it needs of a contact.
    The root mean square of the pulls that the free frames ask for; 0 where they were not asked.
    """
    if drives == 0:
        return 0.0
    variance = (knowledge.common_root[-drives:] ** 2).sum(axis=1)
    return float(np.sqrt((knowledge.common_mean[-drives:] ** 2 + variance).mean()))


def robust_std(rows: Rows, residual: FloatArray) -> FloatArray:
    """Return standard deviations that are larger where residuals stand out (Huber), and for rows that err together [m], shape (r,)."""
    std = rows.std * np.sqrt(rows.together)
    return np.asarray(std * np.sqrt(np.maximum(np.abs(residual / rows.std) / cut_of(residual / rows.std), 1.0)))


def cut_of(z: FloatArray) -> float:
    """Return from which size on a whitened residual stands out [1]."""
    return HUBER * max(1.483 * float(np.median(np.abs(z))), 1.0)


def learn(knowledge: Knowledge, frames: list[tuple[Rows, FloatArray]]) -> Knowledge:
    """Return what free frames teach.

    How many neighbouring points err together; pose and modulus with the sizes of the two shared errors, by maximum likelihood over a grid; then how
    large the misfit is that free frames leave.

    Arguments:
        knowledge: what was known before.
        frames: rows of each free frame, of its cloud and of its markers, each with the moves of `sag_at`.
    """
    if not frames:
        return knowledge
    v = knowledge.common_root.shape[0] - len(frames[0][1])  # pose steps
    wider = np.append(np.full(v, APART if len(frames[0][1]) > 1 else 1.0), np.ones(len(frames[0][1])))
    first = replace(knowledge, common_root=freeze(wider[:, None] * knowledge.common_root))
    for _ in range(2):  # the second time with what the first left
        frames = [(replace(rows, together=knowledge.together if rows.of_clouds else 1.0), sag) for rows, sag in frames]
        grams = [_gram(knowledge, rows, sag) for rows, sag in frames]
        knowledge = _fit_common(knowledge, grams, first)
        for _ in range(2):
            knowledge = _fit_field(knowledge, grams, _most(frames))
            knowledge = _fit_common(knowledge, grams, first)
        knowledge = replace(knowledge, together=_together(knowledge, frames))
    misfits = np.array([misfit(knowledge, rows, sag) for rows, sag in frames if rows.of_clouds])
    return replace(knowledge, misfit_limit=float(misfits.max() + 3.0 * max(misfits.std(), 0.05)))


def misfit(knowledge: Knowledge, rows: Rows, sag: FloatArray) -> float:
    """Return the mean of Huber's function of the whitened residual with nuisance fitted: about 1 where all is explained.

    A row counts as OUTLIER at most: flying pixels, which are many standard deviations off, would else say what a frame leaves.
    """
    left = np.abs(whitened_rest(knowledge, rows, sag))
    return float(huber(np.minimum(left, OUTLIER), HUBER).sum() / max(len(left), 1))


def whitened_rest(knowledge: Knowledge, rows: Rows, sag: FloatArray) -> FloatArray:
    """Return what the fitted nuisance leaves of the residual, in standard deviations, shape (r,)."""
    columns, known = nuisance_columns(knowledge, rows, sag)
    residual = rows.residual - known
    return np.asarray((residual - columns @ misfit_of(residual, columns, rows)[1]) / rows.std)


def huber(z: FloatArray, cut: float) -> FloatArray:
    """Return Huber's function of sizes (r,) ≥ 0: their squares, linear beyond the cut."""
    return np.asarray(np.where(z <= cut, z**2, cut * (2.0 * z - cut)))


def misfit_of(residual: FloatArray, columns: FloatArray, rows: Rows) -> tuple[float, FloatArray]:
    """Return Huber's function of the whitened residual with unit nuisance fitted, summed, and the nuisance."""
    std = robust_std(rows, residual)
    A = columns / std[:, None]
    fitted = np.linalg.solve(A.T @ A + np.eye(columns.shape[1]), A.T @ (residual / std))
    z = np.abs(residual - columns @ fitted) / rows.std
    cut = cut_of(residual / rows.std)
    return float(huber(z, cut).sum() / rows.together + fitted @ fitted), np.asarray(fitted, dtype=np.float64)


# --- helpers ----------------------------------------------------------------------------------------------------------


def _together(knowledge: Knowledge, frames: list[tuple[Rows, FloatArray]]) -> float:
    """Return how many points count as one, since a camera matches windows: variance of sums over cells beside that of points that err alone."""
    sums, squares = 0.0, 0.0
    for rows, sag in (frame for frame in frames if frame[0].of_clouds):
        z = np.clip(whitened_rest(knowledge, rows, sag), -HUBER, HUBER)
        cells = np.floor(rows.place / (CELL * knowledge.length)).astype(np.int64)
        _, group = np.unique(cells, axis=0, return_inverse=True)
        sums += float((np.bincount(group.ravel(), z) ** 2).sum())
        squares += float((z**2).sum())
    return max(1.0, sums / max(squares, 1e-12))


def _kernel(knowledge: Knowledge, places: FloatArray) -> FloatArray:
    """Return smooth weights of each place to each centre, squares summing to 1, shape (r, p)."""
    squared = np.zeros((len(places), len(knowledge.centres)))
    for i in range(3):
        squared += (places[:, None, i] - knowledge.centres[None, :, i]) ** 2
    weight = np.exp(-0.5 * (squared - squared.min(axis=1, keepdims=True)) / knowledge.length**2)
    return np.asarray(weight / np.sqrt((weight**2).sum(axis=1, keepdims=True)))


def _gram(knowledge: Knowledge, rows: Rows, sag: FloatArray) -> FloatArray:
    """Return all inner products of (field, way × field, common, residual) in whitened rows, shape (2p + c + 1,) squared."""
    std = robust_std(rows, rows.residual)
    field = rows.of_clouds * _kernel(knowledge, rows.place)  # that of a marker is in its standard deviation
    A = np.hstack([field, rows.way[:, None] * field, common_columns(rows, sag), rows.residual[:, None]]) / std[:, None]
    return np.asarray(A.T @ A)


def _projected(knowledge: Knowledge, gram: FloatArray) -> tuple[FloatArray, float]:
    """Return the inner products of (common, residual) with the field as correlated noise, and log det of its covariance."""
    p = 2 * len(knowledge.centres)
    scale = np.concatenate([np.full(p // 2, knowledge.bias_m), np.full(p // 2, knowledge.model_share)])
    core = np.eye(p) + scale[:, None] * gram[:p, :p] * scale
    side = scale[:, None] * gram[:p, p:]
    return gram[p:, p:] - side.T @ np.linalg.solve(core, side), float(np.linalg.slogdet(core)[1])


def _fit_common(knowledge: Knowledge, grams: list[FloatArray], first: Knowledge) -> Knowledge:
    """Return pose steps and modulus with their covariance, from their first prior and the free frames together."""
    total = np.asarray(sum(_projected(knowledge, gram)[0] for gram in grams))
    normal, right, root = total[:-1, :-1], total[:-1, -1], first.common_root
    inner = np.eye(root.shape[1]) + root.T @ normal @ root
    mean = first.common_mean + root @ np.linalg.solve(inner, root.T @ (right - normal @ first.common_mean))
    return replace(knowledge, common_mean=freeze(mean), common_root=freeze(root @ _root(np.linalg.inv(inner))))


def _most(frames: list[tuple[Rows, FloatArray]]) -> tuple[float, float]:
    """Return how large shared errors can be that no free frame contradicts: what the worst of them leaves [m], and that over the way from rest."""
    clouds = [rows for rows, _ in frames if rows.of_clouds]
    sizes = np.array([1.483 * np.median(np.abs(rows.residual)) for rows in clouds])
    ways = np.array([np.sqrt(np.mean(rows.way**2)) for rows in clouds])
    return float(sizes.max(initial=0.0)), float((sizes / np.maximum(ways, 1e-6)).max(initial=0.0))


def _fit_field(knowledge: Knowledge, grams: list[FloatArray], most: tuple[float, float]) -> Knowledge:
    """Return the sizes of the shared errors that are likeliest for these frames; they are no larger than what the frames leave.

    Where the noise is far below the errors of the model, the field would else grow without bound: it is too smooth for them, and bends as far as it may.
    """
    x = np.append(-knowledge.common_mean, 1.0)
    best, chosen = np.inf, knowledge
    for bias in (0.0, *(float(b) for b in BIAS_STEPS[1:] if b <= most[0])):
        for share in (0.0, *(float(s) for s in SHARE_STEPS[1:] if s <= most[1])):
            tried = replace(knowledge, bias_m=bias, model_share=share)
            parts = [_projected(tried, gram) for gram in grams]
            value = sum(float(x @ left @ x) + logdet for left, logdet in parts)
            if value < best:
                best, chosen = value, tried
    return chosen


def _spacing(points: FloatArray, size: float) -> float:
    if len(points) < 2:
        return size
    distance = np.linalg.norm(points[:, None] - points[None], axis=2) + size * np.eye(len(points))
    return float(np.median(distance.min(axis=1)))


def _root(covariance: FloatArray) -> FloatArray:
    """Return a square root of a covariance, of the same shape."""
    values, vectors = np.linalg.eigh(covariance) if covariance.size else (np.zeros(0), np.zeros((0, 0)))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
