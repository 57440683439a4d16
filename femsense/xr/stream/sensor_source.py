"""Sensors as a stream: readings, the learnt model, bones, and a tube around them where there is no other mesh."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from femsense.core.arrays import FloatArray, IntArray
from femsense.xr.gltf import glb_bytes
from femsense.xr.proprioception.model import ProprioceptiveModel
from femsense.xr.skeleton import skeleton_at
from femsense.xr.skinning import INFLUENCES, Skin
from femsense.xr.stream.payloads import Input, Twin, TwinFrame, bone_rows
from femsense.xr.stream.publisher import STALE_S
from femsense.xr.stream.readings import Readings

AROUND, BETWEEN = 20, 6
"""Vertices around the tube, and rings between neighbouring bones."""
THICKNESS = 1 / 16
"""Radius of the tube, as a share of its length."""


def sensor_twin(model: ProprioceptiveModel, name: str) -> Twin:
    """Return what streams of a learnt model: a tube around its chain of bones. Raises InputError where it has no chain."""
    rest = model.rest_bones
    skin, triangles = tube_around(rest.positions, rest.T_robot_bone[:, :3, :2])
    still = np.tile(skin.skeleton.T_robot_bone, (1, 1, 1, 1))
    glb = glb_bytes(skin.rest, triangles, skin, still, [0.0], name=name)
    inputs = tuple(
        Input(channel, "", float(low), float(high), "learnt")
        for channel, low, high in zip(model.channels, model.domain.low, model.domain.high)
    )
    return Twin(name, glb, skin.skeleton.names, skin.skeleton.T_robot_bone, inputs=inputs, frame=model.frame)


def frames_of_sensors(readings: Readings, model: ProprioceptiveModel) -> Iterator[TwinFrame]:
    """Yield a frame for each row of readings (see `readings_of`).

    Where a reading that the model needs is no number, the last good pose is kept, with the time at which that was read.
    """
    live, straight = model.live(), np.linalg.inv(model.rest_bones.T_robot_bone)
    straight[:, :3, 3] = 0.0
    bones = bone_rows(skeleton_at(model.rest_bones.positions).T_robot_bone)
    read_at = float("-inf")
    for time_s, row in readings:
        pose = live.step(row, time_s)
        if pose.bones is not None:
            read_at = readings.came
            bones = bone_rows(pose.bones.T_robot_bone @ straight)  # bones that have the robot's axes at rest
        said = "; ".join(item.text for item in pose.outside[:2])
        inputs = tuple(float(v) for v in row)
        yield TwinFrame(time_s, bones, contacts=None, inputs=inputs, status=said or "ok", read_at=read_at)


def markers_of_sensors(readings: Readings, model: ProprioceptiveModel) -> Iterator[tuple[float, dict[str, FloatArray], str]]:
    """Yield the time [s] and the places of the markers [m], name → shape (3,), of each reading (see `readings_of`).

    Of readings outside of what the model was taught there are no places, which would be guesses, but why there are none.
    Those that are old when they come are left out.
    """
    live = model.live()
    for time_s, row in readings:
        pose = live.step(row, time_s)
        if time.monotonic() - readings.came <= STALE_S:
            why = "; ".join(item.text for item in pose.outside[:1])
            yield time_s, {} if why else dict(zip(model.marker_names, pose.markers)), why


def tube_around(places: FloatArray, across: FloatArray) -> tuple[Skin, IntArray]:
    """Return a closed tube around a chain of bones, and its triangles, shape (t, 3).

    Arguments:
        places: of the bones at rest, in their order along the body [m], shape (b, 3).
        across: two unit vectors across the body at each bone, shape (b, 3, 2).

    Returns:
        the skin, its bones with the robot's axes at rest, and triangles that look outward.
    """
    b = len(places)
    length = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum()) or 1e-3
    half = 0.5 * length / max(b - 1, 1)
    at = np.linspace(-half, length + half, BETWEEN * b + 1) / (2 * half)  # in bones, from the first
    k = np.clip(np.floor(at).astype(int), 0, max(b - 2, 0))
    share = (at - k)[:, None] if b > 1 else np.zeros((len(at), 1))
    nearest = np.clip(np.rint(at).astype(int), 0, b - 1)
    middle = (1 - share) * places[k] + share * places[np.minimum(k + 1, b - 1)]
    angle = np.linspace(0.0, 2 * np.pi, AROUND, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    ring = middle[:, None] + THICKNESS * length * np.einsum("rij,ja->rai", across[nearest], circle)
    points = np.vstack([ring.reshape(-1, 3), middle[:1], middle[-1:]])
    blend = np.clip(share[:, 0], 0.0, 1.0)
    weights = np.zeros((len(points), INFLUENCES))
    joints = np.zeros((len(points), INFLUENCES), dtype=np.int64)
    owner = np.concatenate([np.repeat(np.arange(len(at)), AROUND), [0, len(at) - 1]])
    weights[:, 0], weights[:, 1] = 1 - blend[owner], blend[owner]
    joints[:, 0], joints[:, 1] = k[owner], np.minimum(k + 1, b - 1)[owner]
    joints[weights == 0.0] = 0
    return Skin(skeleton_at(places), points, joints, weights), _tube_triangles(len(at))


def _tube_triangles(rings: int) -> IntArray:
    i = np.arange(AROUND)
    n = (i + 1) % AROUND
    found = []
    for r in range(rings - 1):
        a, b = r * AROUND, (r + 1) * AROUND
        found += [np.stack([a + i, a + n, b + i], 1), np.stack([a + n, b + n, b + i], 1)]
    low, high = rings * AROUND, rings * AROUND + 1
    last = (rings - 1) * AROUND
    found += [np.stack([np.full(AROUND, low), n, i], 1), np.stack([np.full(AROUND, high), last + i, last + n], 1)]
    return np.vstack(found)
