"""The pose that free frames show beside an error that neighbouring points share: what looks like a pose is one.

A smooth error of the model over the body, as large as free frames let expect, may be written as a pose that is far off and an opposite error. Both
together fit a little better than a small pose and a small error, and where an object touches would be off by that pose. So the shared error is held
orthogonal to the pose in each frame (restricted spatial regression, Reich, Hodges & Zadnik 2006, Biometrics 62).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.sensing.nuisance import Prior, commons, gram_of
from femsense.sensing.row_noise import weighed
from femsense.sensing.types import Knowledge, Rows


def commons_beside_field(
    first: Knowledge, learned: Knowledge, frames: Sequence[tuple[Rows, FloatArray]], pose_steps: int
) -> FloatArray:
    """Return pose steps, modulus and pulls as the free frames show them where shared errors are no poses, shape (6 v + 1 + a + c,).

    Arguments:
        first: what was known before.
        learned: what the frames taught: how large shared errors are.
        frames: rows of each free frame, of its cloud and of its markers, each with the moves of `sag_at`.
        pose_steps: 6 v.
    """
    grams = [without_poses(gram_of(learned, weighed(learned, rows), moves), pose_steps, commons(first)) for rows, moves in frames]
    return Prior.of(first, frames[0][1]).posterior(learned, grams).mean[: commons(first)]


def without_poses(gram: FloatArray, pose_steps: int, c: int) -> FloatArray:
    """Return the inner products of a frame with its field orthogonal to the pose.

    Arguments:
        gram: of (pose, other commons, field, way × field, residual), as `gram_of` has it.
        pose_steps: how many of the first columns are the pose's.
        c: how many columns are not the field's, before it.
    """
    pose, field = slice(0, pose_steps), slice(c, len(gram) - 1)
    change = np.eye(len(gram))
    change[pose, field] = -np.linalg.lstsq(gram[pose, pose], gram[pose, field], rcond=1e-10)[0]
    return np.asarray(change.T @ gram @ change)
