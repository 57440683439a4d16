"""Bones: their poses on the body at rest, and their placement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from femsense.core.arrays import FloatArray, IntArray, as_points, freeze
from femsense.core.errors import InputError

MAX_BONES = 255
"""The joint numbers of a file are bytes."""


@dataclass(frozen=True, eq=False, slots=True)
class Skeleton:
    """Bones without hierarchy: each moves as a rigid body of its own in the robot frame."""

    T_robot_bone: FloatArray
    """Pose of each bone at rest, translation in [m], shape (B, 4, 4)."""
    names: tuple[str, ...]
    """Name of each bone, B of them."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_robot_bone", freeze(self.T_robot_bone))
        shape = self.T_robot_bone.shape
        if len(shape) != 3 or shape[1:] != (4, 4) or not 1 <= shape[0] <= MAX_BONES:
            raise InputError("wrong bone poses", where="T_robot_bone", found=shape, expected=f"(B, 4, 4), B in 1 … {MAX_BONES}")
        if len(self.names) != shape[0]:
            raise InputError("one name a bone", where="names", found=len(self.names), expected=shape[0])

    def __len__(self) -> int:
        return len(self.names)

    @property
    def origins(self) -> FloatArray:
        """Bone origins at rest [m], shape (B, 3)."""
        return self.T_robot_bone[:, :3, 3]


def skeleton_at(origins: FloatArray) -> Skeleton:
    """Return bones at the given places [m], shape (B, 3), with the axes of the robot frame."""
    origins = as_points(origins, "origins")
    T_robot_bone = np.tile(np.eye(4), (len(origins), 1, 1))
    T_robot_bone[:, :3, 3] = origins
    return Skeleton(T_robot_bone, tuple(f"bone_{i:02d}" for i in range(len(origins))))


def farthest_points(points: FloatArray, count: int) -> IntArray:
    """Return indices of `count` points that lie far from each other, shape (count,).

    Begins with the point that is farthest from the middle and adds, each time, the one that is farthest from all before
    (Gonzalez 1985: within a factor of two of the best covering). Fewer come back where points coincide.

    Arguments:
        points: positions [m], shape (n, d).
        count: how many, at least 1.
    """
    chosen = [int(((points - points.mean(axis=0)) ** 2).sum(axis=1).argmax())]
    distance = ((points - points[chosen[0]]) ** 2).sum(axis=1)
    while len(chosen) < min(count, len(points)):
        farthest = int(distance.argmax())
        if distance[farthest] <= 0.0:
            break
        chosen.append(farthest)
        distance = np.minimum(distance, ((points - points[farthest]) ** 2).sum(axis=1))
    return np.array(chosen, dtype=np.int64)
