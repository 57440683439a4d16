"""What moves the rows beside contact forces: pose, modulus, and errors that neighbours share; and what free frames teach of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np
from scipy.linalg import block_diag
from scipy.stats import chi2

from femsense.core.arrays import FloatArray, freeze
from femsense.fem.assembly import internal
from femsense.fem.compliance import Tangent, drive_rows
from femsense.fem.equilibrium import Equilibrium
from femsense.model.camera import CameraNoise
from femsense.model.robot import spread_points
from femsense.sensing.row_noise import Left, err_together, scatter, slant_of, weighed
from femsense.sensing.types import Knowledge, Rows, Sensor

CENTRES = 24
"""Centres of the field of shared errors: as many degrees of freedom as its error may have along the body."""
HUBER = 2.5
"""Whitened residuals beyond this count linearly."""
ASIDE = 2.0
"""Opposite faces count as so many times twice the length of shared errors apart: across an edge nearly nothing is shared."""
OUTLIER = 5.0
"""Where states are compared and a frame is judged, whitened residuals of points beyond this count as this."""
BIAS_STEPS = 5e-6 * 2.0 ** np.arange(10)
SHARE_STEPS = 0.000625 * 2.0 ** np.arange(8)
"""Sizes of the shared errors that are tried: 0.005 … 2.6 mm, and 0.06 … 8 % of the way."""
SIZES_STD = 8.0
"""By what factor they may be off from those that are expected beforehand."""
FIRST_BIAS, FIRST_SHARE = 1e-4, 0.01
"""The sizes before a free frame is seen [m], [1]."""
ALIKE_STEPS = (0.0, 0.5, 0.8, 0.95)
"""Shares of the variance of the shared errors that may be alike in all free frames."""
SELDOM = 1e-3
"""How often noise alone may say that a frame is not explained."""
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
    places: FloatArray,
    facing: FloatArray,
    size: float,
    modulus_std: float,
    pose_covariance: FloatArray,
    *,
    drives: int = 0,
) -> Knowledge:
    """Return what is known before a free frame is seen.

    Arguments:
        noises: of each camera.
        places: of the surface at rest [m], shape (s, 3).
        facing: outward unit normals there, shape (s, 3).
        size: diagonal of the body [m].
        modulus_std: relative.
        pose_covariance: of all cameras' (rotation, shift), shape (6 v, 6 v).
        drives: cables and chambers.
    """
    length = 0.7 * _spacing(places[spread_points(places, CENTRES)], size)
    chosen = spread_points(np.hstack([places, ASIDE * length * facing]), CENTRES)
    centres = places[chosen]
    v = len(pose_covariance)
    root = np.diag(np.concatenate([np.zeros(v), [modulus_std], np.full(drives, DRIVE_STD)]))
    root[:v, :v] = _root(pose_covariance)
    fields = np.repeat([FIRST_BIAS, FIRST_SHARE], len(centres))
    return Knowledge(
        noises=noises,
        centres=freeze(centres),
        facing=freeze(facing[chosen]),
        length=length,
        bias_m=FIRST_BIAS,
        model_share=FIRST_SHARE,
        mean=freeze(np.zeros(len(root) + len(fields))),
        root=freeze(block_diag(root, np.diag(fields))),
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
    return commons(sensor.knowledge) - 6 * len(sensor.calibration.poses) - 1


def commons(knowledge: Knowledge) -> int:
    """Return how many numbers all frames have in common beside shared errors: pose steps, modulus and pulls."""
    return len(knowledge.mean) - 2 * len(knowledge.centres)


def nuisance_columns(knowledge: Knowledge, rows: Rows, sag: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the columns of unit nuisance (r, q) [m] and what the free frames say that they add to the residual (r,) [m]."""
    field = _kernel(knowledge, rows)
    every = np.hstack([common_columns(rows, sag), field, rows.way[:, None] * field])
    mean = knowledge.mean.copy()
    mean[commons(knowledge) :] *= rows.of_clouds  # markers do not see what clouds have alike
    return every @ knowledge.root, every @ mean


def common_columns(rows: Rows, sag: FloatArray) -> FloatArray:
    """Return how the residual changes with pose steps, the modulus and the pulls, shape (r, 6 v + 1 + a + c)."""
    return np.hstack([rows.by_pose, rows.functional(sag)])


def robust_std(rows: Rows, residual: FloatArray, *, firm: bool = False) -> FloatArray:
    """Return standard deviations that are larger where residuals stand out (Huber), and for rows that err together [m], shape (r,).

    `firm`: outliers tell nothing, and theirs are infinite. That is for states near the answer (MM-estimate, Yohai 1987): those that mix
    two depths lie all on one side, and many small pulls move a small contact.
    """
    std, z = rows.std * np.sqrt(rows.together / rows.weight), rows.sizes(residual)
    cut = cut_of(rows, residual)
    wider = np.sqrt(np.maximum(z / cut, 1.0))
    return np.asarray(std * np.where(firm & rows.of_clouds & (z > OUTLIER / HUBER * cut), np.inf, wider))


def cut_of(rows: Rows, residual: FloatArray) -> float:
    """Return from which size on a whitened residual stands out [1]."""
    return HUBER * max(rows.spread(residual), 1.0)


def learn(
    knowledge: Knowledge, frames: list[tuple[Rows, FloatArray]], judged: list[tuple[Rows, FloatArray]] | None = None
) -> Knowledge:
    """Return what free frames teach.

    How noise grows with incidence, how many neighbouring points err together and how rough they are; pose, modulus and pulls, and the shared errors:
    what all frames have of them alike, and the sizes of both, by maximum likelihood over a grid; then how large misfit and nuisance are that free
    frames leave.

    Arguments:
        knowledge: what was known before.
        frames: rows of each free frame, of its cloud and of its markers, each with the moves of `sag_at`.
        judged: rows of their clouds as frames are judged by, where these are others (means of points).
    """
    if not frames:
        return knowledge
    first = Prior.of(knowledge, frames[0][1])
    knowledge = replace(knowledge, slant=slant_of(knowledge, _left(knowledge, frames)))
    for _ in range(2):  # the second time with what the first left
        shown = [(weighed(knowledge, rows), sag) for rows, sag in frames]
        grams = [gram_of(knowledge, rows, sag) for rows, sag in shown]
        knowledge = first.posterior(_fit_field(knowledge, grams, first), grams)
        left = _left(knowledge, shown)
        rough, together = knowledge.rough * max(1.0, scatter(left)), err_together(left, knowledge.length, HUBER)
        knowledge = replace(knowledge, together=together, rough=rough)
    knowledge = _alike(knowledge, [gram_of(knowledge, weighed(knowledge, rows), sag) for rows, sag in frames])
    clouds = [(weighed(knowledge, rows), sag) for rows, sag in judged or frames if rows.of_clouds]
    if not clouds:
        return knowledge
    misfits = np.array([misfit(knowledge, rows, sag) for rows, sag in clouds])
    excess = np.array([nuisance_excess(knowledge, rows, sag) for rows, sag in clouds])
    through = np.array([rows.through for rows, _ in clouds])
    return replace(
        knowledge,
        misfit_limit=_limit(misfits, 0.05),
        nuisance_limit=max(1.0, _limit(excess, 0.05)),
        through_limit=_limit(through, 0.01),
    )


def _limit(seen: FloatArray, least: float) -> float:
    """Return what a value may be at most that was so large in free frames; they scatter by `least` at least."""
    return float(seen.max() + 3.0 * max(seen.std(), least))


def nuisance_excess(knowledge: Knowledge, rows: Rows, sag: FloatArray) -> float:
    """Return χ² of the fitted nuisance over what noise and free frames let expect of it once in 1000 frames [1].

    The nuisance is a smooth error, and may take up what touches: the rows then fit well, and only its size tells.
    With unit prior and N = AᵀA of the whitened columns, the fitted nuisance has the covariance N (N + 1)⁻¹; its χ² is that of a gamma
    distribution with the same mean and variance (Satterthwaite 1946).
    """
    columns, known = nuisance_columns(knowledge, rows, sag)
    residual = rows.residual - known
    fitted = misfit_of(residual, columns, rows)[1]
    A = columns / robust_std(rows, residual)[:, None]
    seen = np.linalg.eigvalsh(A.T @ A)
    share = np.maximum(seen, 0.0) / (1.0 + np.maximum(seen, 0.0))
    degrees = share.sum() ** 2 / max(float((share**2).sum()), 1e-12)
    return float(fitted @ fitted / max(share.sum() / degrees * chi2.isf(SELDOM, degrees), 1e-12)) if degrees > 0 else 0.0


def misfit(knowledge: Knowledge, rows: Rows, sag: FloatArray) -> float:
    """Return the mean of Huber's function of the whitened residual with nuisance fitted: about 1 where all is explained.

    A row counts as OUTLIER at most: flying pixels, which are many standard deviations off, would else say what a frame leaves.
    """
    left = rows.sizes(rows.std * whitened_rest(knowledge, rows, sag))
    return float(rows.weight @ huber(np.minimum(left, OUTLIER), HUBER) / max(rows.weight.sum(), 1.0))


def whitened_rest(knowledge: Knowledge, rows: Rows, sag: FloatArray) -> FloatArray:
    """Return what the fitted nuisance leaves of the residual, in standard deviations, shape (r,)."""
    columns, known = nuisance_columns(knowledge, rows, sag)
    residual = rows.residual - known
    return np.asarray((residual - columns @ misfit_of(residual, columns, rows)[1]) / rows.std)


def huber(z: FloatArray, cut: float) -> FloatArray:
    """Return Huber's function of sizes (r,) ≥ 0: their squares, linear beyond the cut."""
    return np.asarray(np.where(z <= cut, z**2, cut * (2.0 * z - cut)))


def misfit_of(residual: FloatArray, columns: FloatArray, rows: Rows) -> tuple[float, FloatArray]:
    """Return Huber's function of the whitened residual with unit nuisance fitted, summed, and the nuisance.

    A point of a cloud costs no more than an outlier, wherever it lies; one whose ray meets nothing costs by its distance from the surface.
    """
    std = robust_std(rows, residual)
    A = columns / std[:, None]
    fitted = np.linalg.solve(A.T @ A + np.eye(columns.shape[1]), A.T @ (residual / std))
    z, cut = rows.sizes(residual - columns @ fitted), cut_of(rows, residual)
    far = OUTLIER / HUBER * cut if rows.of_clouds else np.inf
    beside = huber(np.minimum(rows.missed, far), cut)
    total = rows.weight @ huber(np.minimum(z, far), cut) + (
        beside.sum() if rows.missed_number is None else rows.missed_number @ beside
    )
    return float(total / rows.together + fitted @ fitted), np.asarray(fitted, dtype=np.float64)


# --- helpers ----------------------------------------------------------------------------------------------------------


def _left(knowledge: Knowledge, frames: list[tuple[Rows, FloatArray]]) -> Left:
    """Return the rows of clouds with what the nuisance leaves of them."""
    return [(rows, whitened_rest(knowledge, rows, sag)) for rows, sag in frames if rows.of_clouds]


def _kernel(knowledge: Knowledge, rows: Rows) -> FloatArray:
    """Return smooth weights of each row to each centre, squares summing to 1, shape (r, p).

    Faces that look elsewhere err on their own: a body that sags too far is too low on its upper face, and right on its sides.
    """
    squared = np.zeros((len(rows.place), len(knowledge.centres)))
    for i in range(3):
        squared += (rows.place[:, None, i] - knowledge.centres[None, :, i]) ** 2
        squared += (ASIDE * knowledge.length * (rows.facing[:, None, i] - knowledge.facing[None, :, i])) ** 2
    weight = np.exp(-0.5 * (squared - squared.min(axis=1, keepdims=True)) / knowledge.length**2)
    return np.asarray(weight / np.sqrt((weight**2).sum(axis=1, keepdims=True)))


def gram_of(knowledge: Knowledge, rows: Rows, sag: FloatArray) -> FloatArray:
    """Return all inner products of (common, field, way × field, residual) in whitened rows, shape (c + 2p + 1,) squared."""
    std = robust_std(rows, rows.residual)
    field = rows.of_clouds * _kernel(knowledge, rows)  # that of a marker is in its standard deviation
    A = np.hstack([common_columns(rows, sag), field, rows.way[:, None] * field, rows.residual[:, None]]) / std[:, None]
    return np.asarray(A.T @ A)


def _sizes(knowledge: Knowledge) -> FloatArray:
    """Return the size of each coefficient of the shared errors, shape (2p,)."""
    return np.repeat([knowledge.bias_m, knowledge.model_share], len(knowledge.centres))


@dataclass(frozen=True, eq=False, slots=True)
class Prior:
    """What was known of poses, modulus and pulls before the free frames."""

    mean: FloatArray  # (c,)
    root: FloatArray  # (c, j)

    @classmethod
    def of(cls, knowledge: Knowledge, moves: FloatArray) -> Prior:
        c = commons(knowledge)
        wider = np.ones(c)
        wider[: c - len(moves)] = APART if len(moves) > 1 else 1.0
        return cls(knowledge.mean[:c], wider[:, None] * knowledge.root[:c])

    def evidence(self, knowledge: Knowledge, grams: list[FloatArray]) -> float:
        """Return −2 log evidence of the free frames, up to a constant."""
        total, logdet = self._total(knowledge, grams)
        mean, _, inner, right = self._solved(knowledge, total)
        left = total[-1, -1] - 2.0 * mean @ total[:-1, -1] + mean @ total[:-1, :-1] @ mean
        return float(left - right @ np.linalg.solve(inner, right) + logdet + np.linalg.slogdet(inner)[1])

    def posterior(self, knowledge: Knowledge, grams: list[FloatArray]) -> Knowledge:
        """Return what the free frames tell of all numbers, as a new frame will have them."""
        mean, root, inner, right = self._solved(knowledge, self._total(knowledge, grams)[0])
        own = np.append(np.zeros(commons(knowledge)), np.sqrt(1.0 - knowledge.alike) * _sizes(knowledge))
        covariance = root @ np.linalg.solve(inner, root.T) + np.diag(own**2)
        return replace(knowledge, mean=freeze(mean + root @ np.linalg.solve(inner, right)), root=freeze(_root(covariance)))

    def _total(self, knowledge: Knowledge, grams: list[FloatArray]) -> tuple[FloatArray, float]:
        """Return the inner products of all frames, what each has of its own as correlated noise, and log det of its covariance."""
        c, total, logdet = commons(knowledge), np.zeros_like(grams[0]), 0.0
        scale = np.sqrt(1.0 - knowledge.alike) * _sizes(knowledge)
        for gram in grams:
            core = np.eye(len(scale)) + scale[:, None] * gram[c:-1, c:-1] * scale
            side = scale[:, None] * gram[c:-1]
            total += gram - side.T @ np.linalg.solve(core, side)
            logdet += float(np.linalg.slogdet(core)[1])
        return total, logdet

    def _solved(self, knowledge: Knowledge, total: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return mean and root beforehand, and the normal equations of unit numbers: matrix and right-hand side."""
        mean = np.append(self.mean, np.zeros(2 * len(knowledge.centres)))
        root = block_diag(self.root, np.diag(np.sqrt(knowledge.alike) * _sizes(knowledge)))
        inner = np.eye(root.shape[1]) + root.T @ total[:-1, :-1] @ root
        return mean, root, inner, root.T @ (total[:-1, -1] - total[:-1, :-1] @ mean)


def _fit_field(knowledge: Knowledge, grams: list[FloatArray], first: Prior) -> Knowledge:
    """Return the sizes of the shared errors that are likeliest for these frames: from those at hand uphill over the grid."""

    def sized(i: int, j: int) -> Knowledge:
        return replace(knowledge, bias_m=float(BIAS_STEPS[i]), model_share=float(SHARE_STEPS[j]))

    @cache
    def unlikely(i: int, j: int) -> float:
        return first.evidence(sized(i, j), grams) + _beforehand(sized(i, j))

    grid, sizes = (BIAS_STEPS, SHARE_STEPS), (knowledge.bias_m, knowledge.model_share)
    here = tuple(int(np.abs(np.log(steps / size)).argmin()) for steps, size in zip(grid, sizes))
    while True:
        around = product(*(range(max(i - 1, 0), min(i + 2, len(steps))) for i, steps in zip(here, grid)))
        best = min(around, key=lambda at: unlikely(*at))
        if best == here:
            return sized(*here)
        here = best


def _beforehand(knowledge: Knowledge) -> float:
    """Return −2 log of the prior of the sizes of shared errors: where frames do not tell them, they stay as they were expected."""
    odds = np.log([knowledge.bias_m / FIRST_BIAS, knowledge.model_share / FIRST_SHARE])
    return float(((odds / np.log(SIZES_STD)) ** 2).sum())


def _alike(knowledge: Knowledge, grams: list[FloatArray]) -> Knowledge:
    """Return what the free frames have alike of the shared errors, and how much of them, about pose, modulus and pulls as they are known."""
    c = commons(knowledge)
    known = Prior(knowledge.mean[:c], np.zeros((c, 0)))
    best = min((replace(knowledge, alike=share) for share in ALIKE_STEPS), key=lambda one: known.evidence(one, grams))
    told = known.posterior(best, grams)
    root = block_diag(*(_root(part @ part.T) for part in (knowledge.root[:c], told.root[c:])))
    return replace(told, mean=freeze(np.append(knowledge.mean[:c], told.mean[c:])), root=freeze(root))


def _spacing(points: FloatArray, size: float) -> float:
    if len(points) < 2:
        return size
    distance = np.linalg.norm(points[:, None] - points[None], axis=2) + size * np.eye(len(points))
    return float(np.median(distance.min(axis=1)))


def _root(covariance: FloatArray) -> FloatArray:
    """Return a square root of a covariance, of the same shape."""
    values, vectors = np.linalg.eigh(covariance) if covariance.size else (np.zeros(0), np.zeros((0, 0)))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
