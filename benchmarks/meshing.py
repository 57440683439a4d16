"""femsense mesh on surfaces of many triangles and on spoilt ones: the table of docs/guides/meshing.md.

python benchmarks/meshing.py [WORD …]

With words only the surfaces whose names contain one of them.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import trimesh

from femsense import InputError
from femsense.io.meshing.filling import fill
from femsense.io.meshing.options import MeshOptions
from femsense.io.meshing.quality import quality_report


def main() -> None:
    """Print a row for each surface."""
    print("| surface | triangles | tetrahedra | radius ratio, worst / median | from the surface | s | done |")
    print("|---|---|---|---|---|---|---|")
    for name, make, options in CASES:
        if len(sys.argv) > 1 and not any(word in name for word in sys.argv[1:]):
            continue
        mesh = make()
        began = time.perf_counter()
        try:
            filled = fill(np.array(mesh.vertices), np.array(mesh.faces), MeshOptions(unit="mm", **options))
        except InputError as error:
            print(f"| {name} | {len(mesh.faces)} | refused: {error.what} | | | {time.perf_counter() - began:.0f} | |", flush=True)
            continue
        seconds, quality = time.perf_counter() - began, quality_report(filled.mesh)
        shape = f"{quality['radius_ratio']['min']:.2f} / {quality['radius_ratio']['median']:.2f}"
        print(
            (
                f"| {name} | {len(mesh.faces)} | {quality['tetrahedra']} | {shape} | {filled.deviation_mm:.2f} mm | "
                f"{seconds:.0f} | {'; '.join(filled.done)} |"
            ),
            flush=True,
        )


def wavy() -> Any:
    """Return a finger of 100 × 30 × 20 mm with grooves, 786 432 triangles."""
    ball = trimesh.creation.box((2, 2, 2))
    for _ in range(9):
        if len(ball.faces) >= 500_000:
            break
        ball = ball.subdivide()
    points = np.array(ball.vertices)
    points /= np.linalg.norm(points, axis=1, keepdims=True) ** 0.8
    points *= [50.0, 15.0, 10.0]
    points[:, 2] *= 1.0 + 0.15 * np.cos(0.5 * points[:, 0])
    return trimesh.Trimesh(points, ball.faces, process=False)


def chambered() -> Any:
    """Return a block with a chamber whose shell faces the wrong way."""
    return trimesh.util.concatenate([trimesh.creation.box((100, 30, 30)), trimesh.creation.box((80, 12, 12))])


def crossing() -> Any:
    """Return two blocks that go through each other."""
    post = trimesh.creation.box((20, 20, 60))
    post.apply_translation([10, 0, 20])
    return trimesh.util.concatenate([trimesh.creation.box((100, 30, 30)), post])


def torn() -> Any:
    """Return a capsule with holes, a tenth of its triangles turned."""
    whole = trimesh.creation.capsule(80, 12, count=[48, 48])
    faces = np.delete(np.array(whole.faces), [100, 101, 700, 2000], axis=0)
    faces[::10] = faces[::10, ::-1]
    return trimesh.Trimesh(whole.vertices, faces, process=False)


def tube() -> Any:
    """Return a tube without ends."""
    whole = trimesh.creation.cylinder(10, 100, sections=48)
    return trimesh.Trimesh(whole.vertices, whole.faces[np.abs(whole.face_normals[:, 2]) < 0.5], process=False)


def thin_walled() -> Any:
    """Return a tube of 100 mm, 20 mm across, with a wall of 0.8 mm."""
    return trimesh.creation.annulus(9.2, 10.0, 100, sections=64)


def threaded() -> Any:
    """Return a rod of 50 mm, 16 mm across, with 14 turns of a thread 1.2 mm high."""
    z, angle = np.linspace(0, 50, 281)[:, None], np.linspace(0, 2 * np.pi, 48, endpoint=False)[None]
    turn = (14 * z / 50 - angle / (2 * np.pi)) % 1
    radius = 8 + 1.2 * (1 - np.abs(2 * turn - 1)) * np.clip(np.minimum(z, 50 - z) / 2, 0, 1)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), z + 0 * radius], axis=2).reshape(-1, 3)
    low = (48 * np.arange(280)[:, None] + np.arange(48)).ravel()
    beside = (48 * np.arange(280)[:, None] + (np.arange(48) + 1) % 48).ravel()
    sides = np.vstack([np.column_stack([low, beside, beside + 48]), np.column_stack([low, beside + 48, low + 48])])
    rim, after, n = np.arange(48), (np.arange(48) + 1) % 48, len(points)
    ends = np.vstack(
        [np.column_stack([after, rim, np.full(48, n)]), np.column_stack([n - 48 + rim, n - 48 + after, np.full(48, n + 1)])]
    )
    return trimesh.Trimesh(np.vstack([points, [[0, 0, 0], [0, 0, 50]]]), np.vstack([sides, ends]), process=False)


def lettered() -> Any:
    """Return a block with raised bars of 0.6 mm, as letters have."""
    bars = [
        trimesh.creation.box((1.2, 8, 1.6), trimesh.transformations.translation_matrix((x, 0, 10))) for x in range(-20, 21, 5)
    ]
    return trimesh.util.concatenate([trimesh.creation.box((100, 20, 20)), *bars])


def noisy() -> Any:
    """Return a ring of 500 000 triangles with noise of a third of an edge, as scans have."""
    ring = trimesh.creation.torus(60, 20, major_sections=1000, minor_sections=250)
    noise = np.random.default_rng(1).normal(0, 0.3 * ring.edges_unique_length.mean(), (len(ring.vertices), 1))
    return trimesh.Trimesh(ring.vertices + noise * ring.vertex_normals, ring.faces, process=False)


CASES: tuple[tuple[str, Callable[[], Any], dict[str, Any]], ...] = (
    ("capsule", lambda: trimesh.creation.capsule(80, 12, count=[48, 48]), {}),
    ("the same, finer", lambda: trimesh.creation.capsule(80, 12, count=[48, 48]), {"most_tets": 8000}),
    ("holes, turned triangles", torn, {}),
    ("a chamber, outward shell", chambered, {}),
    ("two blocks that cross", crossing, {}),
    ("open tube", tube, {}),
    ("open tube, --close-holes", tube, {"close_holes": True}),
    ("very fine", wavy, {}),
    ("a wall of 0.8 mm", thin_walled, {}),
    ("the same, --max-tets 2000", thin_walled, {"most_tets": 2000}),
    ("raised letters", lettered, {}),
    ("a thread", threaded, {}),
    ("a noisy scan", noisy, {}),
)

if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
