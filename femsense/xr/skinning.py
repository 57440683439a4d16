"""Linear blend skinning of a deformed surface: weights of at most four bones per vertex, and bone poses of each frame.

    x_i = Σ_b w_ib (R_b p_i + t_b),   w_ib ≥ 0,   Σ_b w_ib = 1,   at most four w_ib > 0

with p_i the rest position relative to the origin of bone b. Weights and rigid transforms are fitted in turn to frames of
the surface (Le and Deng 2012, Smooth skinning decomposition with rigid bones). With fixed weights, a frame takes one small
product and a few sweeps of rigid fits, each bone fitted to the residual of the others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from femsense.core.arrays import FloatArray, IntArray, as_points, diagonal, freeze, rms
from femsense.core.errors import InputError
from femsense.xr.skeleton import MAX_BONES, Skeleton, farthest_points, skeleton_at
from femsense.xr.skinning_kernels import sweep_poses, weights_of_vertices

INFLUENCES = 4
BONE_COUNTS = (4, 6, 8, 12, 16, 20, 24, 32)
"""Numbers of bones that are tried."""
FIT_VERTICES = 3000
"""Maximum number of vertices used to find bones; the weights of all vertices follow."""
FIT_FRAMES = 80
"""Maximum number of frames used to find bones, the most different ones."""
FEWEST_FRAMES_TO_CHOOSE = 8
"""With fewer frames the number of bones is not chosen on held-out ones."""
DEFAULT_BONES = 12
ROUNDS = 12
"""Rounds of weights and poses."""
FIT_SWEEPS = 12
ONLINE_SWEEPS = 4
NOISE = 1e-6
"""Motion below this share of the body's size carries no information on weights."""
PULL = 1e-3
"""Regularisation of the weights towards smooth ones, as a share of the squared error of single bones."""


@dataclass(frozen=True, eq=False, slots=True)
class Skin:
    """A surface tied to bones."""

    skeleton: Skeleton
    """The bones at rest."""
    rest: FloatArray
    """Vertices at rest, robot frame [m], shape (V, 3)."""
    joints: IntArray
    """Bones of each vertex, shape (V, 4); 0 where the weight is zero."""
    weights: FloatArray
    """Weights of those bones, shape (V, 4); each row sums to 1."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "rest", freeze(as_points(self.rest, "rest")))
        object.__setattr__(self, "joints", freeze(self.joints, np.int64))
        object.__setattr__(self, "weights", freeze(self.weights))
        shape = (len(self.rest), INFLUENCES)
        if self.joints.shape != shape or self.weights.shape != shape:
            raise InputError(
                "joints and weights have the wrong shape",
                where="joints",
                found=(self.joints.shape, self.weights.shape),
                expected=shape,
            )
        if self.joints.size and (self.joints.min() < 0 or self.joints.max() >= len(self.skeleton)):
            raise InputError(
                "a joint does not exist", where="joints", found=int(self.joints.max()), expected=f"0 … {len(self.skeleton) - 1}"
            )
        if not (self.weights >= 0).all() or not np.allclose(self.weights.sum(axis=1), 1.0, atol=1e-6):
            raise InputError("weights must be non-negative and sum to 1", where="weights")

    def weight_matrix(self) -> FloatArray:
        """Return the weights of all bones, shape (B, V)."""
        matrix = np.zeros((len(self.skeleton), len(self.rest)))
        rows = np.repeat(np.arange(len(self.rest)), INFLUENCES)
        np.add.at(matrix, (self.joints.ravel(), rows), self.weights.ravel())
        return matrix


@dataclass(frozen=True, eq=False, slots=True)
class PoseFit:
    """All of a skin that does not change from frame to frame when its poses are fitted."""

    origins: FloatArray
    """Bone origins at rest [m], shape (B, 3)."""
    A: FloatArray
    """Weighted homogeneous rest positions relative to each bone, shape (4 B, V)."""
    N: FloatArray
    """Normal matrices A Aᵀ of all pairs of bones, shape (B, 4, B, 4)."""
    share: FloatArray
    """Σ_i w_ib of each bone, shape (B,)."""

    def __call__(self, vertices: FloatArray, *, start: FloatArray | None = None, sweeps: int = ONLINE_SWEEPS) -> FloatArray:
        """Return the bone poses T_robot_bone of one frame, shape (B, 4, 4).

        Arguments:
            vertices: positions of the surface [m], shape (V, 3). Not checked here: this is the step of every live frame.
            start: poses of the previous frame, shape (B, 4, 4). The better of them and of separate rigid fits is improved.
            sweeps: number of passes in which each bone is fitted to the residual of the others.
        """
        bones = len(self.origins)
        Y = (self.A @ vertices).reshape(bones, 4, 3)
        guess = np.zeros((0, 4, 4)) if start is None else np.ascontiguousarray(start, dtype=np.float64)
        poses: FloatArray = sweep_poses(self.N, Y, self.share, guess, sweeps)
        return poses


def prepare_poses(skin: Skin) -> PoseFit:
    """Return the part of the pose fit that all frames share."""
    return _pose_fit(skin.rest, skin.skeleton.origins, skin.weight_matrix())


def fit_poses(skin: Skin, states: npt.ArrayLike, *, sweeps: int = FIT_SWEEPS) -> FloatArray:
    """Fit the poses of B bones to F frames of a deformed surface with V vertices; the fit of each frame starts from the previous one.

    Arguments:
        skin: the surface at rest, and the weights of its bones.
        states: vertices in each frame, robot frame [m], shape (F, V, 3).
        sweeps: number of passes over the bones in each frame. A live view needs fewer; it computes the part that all frames share only
            once (`prepare_poses`).

    Returns:
        T_robot_bone, from bone to robot coordinates [m], in each frame, shape (F, B, 4, 4).

    Raises:
        InputError: the states are not finite or do not belong to this skin.
    """
    frames = as_states(states, len(skin.rest))
    return _poses_of_frames(prepare_poses(skin), frames, sweeps)


def skin_vertices(skin: Skin, poses: npt.ArrayLike) -> FloatArray:
    """Return the skinned vertices [m], shape (F, V, 3), of bone poses T_robot_bone, shape (F, B, 4, 4).

    Linear blending: x_i = Σ_k w_ik T_robot_bone(k) T_bone_robot_rest(k) p_i.
    """
    T = np.asarray(poses, dtype=np.float64)
    if T.ndim != 4 or T.shape[1:] != (len(skin.skeleton), 4, 4):
        raise InputError("wrong bone poses", where="poses", found=T.shape, expected=f"(F, {len(skin.skeleton)}, 4, 4)")
    result = np.zeros((len(T), len(skin.rest), 3))
    from_rest = np.linalg.inv(skin.skeleton.T_robot_bone)
    for k in range(INFLUENCES):
        joint = skin.joints[:, k]
        local = np.einsum("vij,vj->vi", from_rest[joint, :3, :3], skin.rest) + from_rest[joint, :3, 3]
        for f, T_robot_bone in enumerate(T[:, :, :3]):
            moved = np.einsum("vij,vj->vi", T_robot_bone[joint, :, :3], local) + T_robot_bone[joint, :, 3]
            result[f] += skin.weights[:, k, None] * moved
    return result


def skin_rms(skin: Skin, poses: FloatArray, states: FloatArray) -> float:
    """Return the root mean square distance [m] of the skinned vertices to the states, shape (F, V, 3)."""
    return rms(skin_vertices(skin, poses) - states)


def fit_skin(rest: npt.ArrayLike, states: npt.ArrayLike, *, bones: int | None = None) -> Skin:
    """Fit linear blend skinning to a moving surface: bone poses, and weights of at most four bones per vertex.

    Weights and poses are fitted alternately (skinning decomposition with rigid bones, Le & Deng 2012).

    Arguments:
        rest: vertices at rest, robot frame [m], shape (V, 3).
        states: the same vertices in each frame [m], shape (F, V, 3); one frame is enough.
        bones: number of bones, 1 … 255. Default: chosen on held-out frames among 4 … 32, since more bones than the motion
            needs increase the error on unseen frames; 12 if there are too few frames to hold any out.

    Returns:
        the skin. It has fewer bones if the body has fewer distinct vertices.

    Raises:
        InputError: shapes that do not belong together, no frame, numbers that are not finite, an impossible bone count.
    """
    rest = as_points(rest, "rest")
    frames = as_states(states, len(rest))
    if bones is not None and not 1 <= bones <= MAX_BONES:
        raise InputError("impossible number of bones", where="bones", found=bones, expected=f"1 … {MAX_BONES}")
    used = frames[np.sort(farthest_points(frames.reshape(len(frames), -1), FIT_FRAMES))]
    some = np.sort(farthest_points(rest, FIT_VERTICES)) if len(rest) > FIT_VERTICES else np.arange(len(rest))
    count = bones if bones is not None else _choose_bones(rest[some], frames[:, some])
    origins, poses = _find_bones(rest[some], used[:, some], count)
    joints, weights, poses = _refine(rest[some], used[:, some], origins, poses)
    if len(some) < len(rest):
        joints, weights = _fit_weights(rest, used, origins, poses)
    return _finished(rest, origins, joints, weights)


def weigh_points(skin: Skin, poses: FloatArray, rest: npt.ArrayLike, states: npt.ArrayLike) -> Skin:
    """Return a skin of other points with the same bones: weights that reproduce their motion best with given poses.

    Arguments:
        skin: whose bones are used.
        poses: T_robot_bone of each frame, shape (F, B, 4, 4).
        rest: points at rest, robot frame [m], shape (p, 3).
        states: the points in each frame [m], shape (F, p, 3).
    """
    points, frames = as_points(rest, "rest"), as_states(states, len(np.asarray(rest)))
    origins = np.ascontiguousarray(skin.skeleton.origins)
    parts = [slice(k, k + FIT_VERTICES) for k in range(0, len(points), FIT_VERTICES)]
    found = [_fit_weights(points[part], frames[:, part], origins, np.asarray(poses, dtype=np.float64)) for part in parts]
    weights = np.concatenate([each[1] for each in found])
    return Skin(skin.skeleton, points, np.concatenate([each[0] for each in found]), weights)


def as_states(states: npt.ArrayLike, vertices: int) -> FloatArray:
    """Return states as finite float64, shape (F, V, 3) with F ≥ 1. Raises InputError."""
    frames = np.asarray(states, dtype=np.float64)
    if frames.ndim == 2:
        frames = frames[None]
    if frames.ndim != 3 or frames.shape[1:] != (vertices, 3) or not len(frames):
        raise InputError("states have the wrong shape", where="states", found=frames.shape, expected=f"(F ≥ 1, {vertices}, 3)")
    bad = np.flatnonzero(~np.isfinite(frames).all(axis=(1, 2)))
    if len(bad):
        raise InputError(
            "states must be finite",
            where=f"states[{bad[0]}]",
            found=f"{len(bad)} of {len(frames)} frames with numbers that are not finite",
            expected="finite positions [m]",
            hint="leave out the frames without equilibrium",
        )
    return frames


# ---- how many bones -------------------------------------------------------------------------------------------------


def _choose_bones(rest: FloatArray, frames: FloatArray) -> int:
    """Return the number of bones that serves held-out frames best (the smaller one where two are within 2 % or a millionth of the
    body)."""
    if len(frames) < FEWEST_FRAMES_TO_CHOOSE:
        return min(DEFAULT_BONES, len(rest))
    spread = frames[np.sort(farthest_points(frames.reshape(len(frames), -1), FIT_FRAMES))]
    held_out = np.arange(len(spread)) % 3 == 1
    best, best_rms = min(BONE_COUNTS[0], len(rest)), np.inf
    for count in (c for c in BONE_COUNTS if c <= max(1, len(rest) // 4)):
        origins, poses = _find_bones(rest, spread[~held_out], count)
        joints, weights, _ = _refine(rest, spread[~held_out], origins, poses)
        skin = _finished(rest, origins, joints, weights)
        unseen = skin_rms(skin, fit_poses(skin, spread[held_out]), spread[held_out])
        if unseen < 0.98 * best_rms - NOISE * _size(rest):
            best, best_rms = count, unseen
        elif unseen > 1.5 * best_rms:
            break
    return best


# ---- where the bones sit: parts of the surface that move as one -------------------------------------------------------


def _find_bones(rest: FloatArray, frames: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return bone origins (B, 3) and poses (F, B, 4, 4) of groups of vertices that move almost rigidly.

    Lloyd's rounds: every vertex joins the bone that predicts its motion best (near bones first),
    every bone is fitted to its vertices.
    """
    seeds = rest[farthest_points(rest, count)]
    size = _size(rest)
    label = ((rest[:, None] - seeds) ** 2).sum(axis=2).argmin(axis=1)
    for _ in range(8):
        origins, poses = _rigid_groups(rest, frames, label, len(seeds))
        error = np.zeros((len(rest), len(seeds)))
        for b in range(len(seeds)):
            predicted = np.einsum("fij,vj->fvi", poses[:, b, :3, :3], rest - origins[b]) + poses[:, b, None, :3, 3]
            error[:, b] = ((predicted - frames) ** 2).sum(axis=2).mean(axis=0)
        near = ((rest[:, None] - origins) ** 2).sum(axis=2)
        moved = (error + (NOISE + 1e-3 * error.mean() / size**2) * near).argmin(axis=1)
        alive = np.bincount(moved, minlength=len(seeds)) > 0
        if not alive.all() or (moved == label).all():
            break
        label = moved
    return origins, poses


def _rigid_groups(rest: FloatArray, frames: FloatArray, label: IntArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return centroids (B, 3) and best rigid poses (F, B, 4, 4) of groups of vertices."""
    member = (label == np.arange(count)[:, None]).astype(float)
    origins = member @ rest / member.sum(axis=1)[:, None]
    fit = _pose_fit(rest, origins, member)
    return origins, _poses_of_frames(fit, frames, 1)


# ---- weights and poses in turn ----------------------------------------------------------------------------------------


def _refine(
    rest: FloatArray, frames: FloatArray, origins: FloatArray, poses: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return joints (V, 4), weights (V, 4) and poses (F, B, 4, 4) after rounds of both fits, as long as these help."""
    last = np.inf
    floor = 1e-9 * _size(rest)
    for _ in range(ROUNDS):
        joints, weights = _fit_weights(rest, frames, origins, poses)
        dense = np.zeros((len(origins), len(rest)))
        np.add.at(dense, (joints.ravel(), np.repeat(np.arange(len(rest)), INFLUENCES)), weights.ravel())
        fit = _pose_fit(rest, origins, dense)
        for f, frame in enumerate(frames):
            poses[f] = fit(frame, start=poses[f], sweeps=FIT_SWEEPS // 2)
        predicted = np.einsum("bv,fbij,bvj->fvi", dense, poses[:, :, :3, :3], rest - origins[:, None], optimize=True)
        now = rms(predicted + np.einsum("bv,fbi->fvi", dense, poses[:, :, :3, 3]) - frames)
        if now > last - max(1e-3 * last, floor):
            break
        last = now
    joints, weights = _fit_weights(rest, frames, origins, poses)
    return joints, weights, poses


def _fit_weights(rest: FloatArray, frames: FloatArray, origins: FloatArray, poses: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return joints (V, 4) and weights (V, 4) that reproduce the frames best with these poses."""
    smooth = _smooth_weights(rest, origins)
    tiny = (NOISE * _size(rest)) ** 2
    states = np.ascontiguousarray(frames.transpose(1, 0, 2))
    joints, weights = weights_of_vertices(rest, states, origins, np.ascontiguousarray(poses), smooth, tiny, PULL)
    return joints, weights


def _smooth_weights(rest: FloatArray, origins: FloatArray) -> FloatArray:
    """Return weights (V, B) that decrease with distance: inverse squared distances to the four nearest bones.

    The fifth distance is subtracted, so that the weights are continuous where the set of nearest bones changes.
    """
    squared = ((rest[:, None] - origins) ** 2).sum(axis=2)
    inverse = 1.0 / (squared + 1e-6 * _size(rest) ** 2)
    if len(origins) > INFLUENCES:
        inverse = np.maximum(inverse - np.sort(inverse, axis=1)[:, -INFLUENCES - 1, None], 0.0)
    total = inverse.sum(axis=1, keepdims=True)
    nearest = np.eye(len(origins))[squared.argmin(axis=1)]
    return np.asarray(np.where(total > 0, inverse / np.where(total > 0, total, 1.0), nearest))


def _finished(rest: FloatArray, origins: FloatArray, joints: IntArray, weights: FloatArray) -> Skin:
    """Return the skin with each bone at the weighted centre of its vertices (weights squared),
    without bones that carry no weight."""
    dense = np.zeros((len(origins), len(rest)))
    np.add.at(dense, (joints.ravel(), np.repeat(np.arange(len(rest)), INFLUENCES)), weights.ravel())
    used = (dense**2).sum(axis=1) > 1e-12
    middle = (dense[used] ** 2) @ rest / (dense[used] ** 2).sum(axis=1)[:, None]
    number = np.zeros(len(origins), dtype=np.int64)
    number[used] = np.arange(used.sum())
    weights = np.where(used[joints], weights, 0.0)
    weights = weights / weights.sum(axis=1, keepdims=True)
    return Skin(skeleton_at(middle), rest, np.where(weights > 0, number[joints], 0), weights)


# ---- poses with fixed weights -------------------------------------------------------------------------------------------


def _pose_fit(rest: FloatArray, origins: FloatArray, weights: FloatArray) -> PoseFit:
    bones, vertices = weights.shape
    A = np.empty((bones, 4, vertices))
    A[:, :3] = ((rest - origins[:, None]) * weights[:, :, None]).transpose(0, 2, 1)
    A[:, 3] = weights
    stacked = A.reshape(4 * bones, vertices)
    N = (stacked @ stacked.T).reshape(bones, 4, bones, 4)
    return PoseFit(freeze(origins), freeze(stacked), freeze(N), freeze(weights.sum(axis=1)))


def _poses_of_frames(fit: PoseFit, frames: FloatArray, sweeps: int) -> FloatArray:
    poses = np.empty((len(frames), len(fit.origins), 4, 4))
    before: FloatArray | None = None
    for f, frame in enumerate(frames):
        before = poses[f] = fit(frame, start=before, sweeps=sweeps)
    return poses


def _size(rest: FloatArray) -> float:
    """Return the diagonal of the bounding box [m], never 0."""
    return diagonal(rest) or 1.0
