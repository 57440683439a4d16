"""femsense mesh on surfaces of many triangles and on spoilt ones: the table of docs/meshing.md.

python benchmarks/meshing.py
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import trimesh

from femsense import InputError
from femsense.io.meshing.filling import MeshOptions, fill
from femsense.io.meshing.quality import quality_report


def main() -> None:
    """Print a row for each surface."""
    print("| surface | triangles | tetrahedra | radius ratio, worst / median | from the surface | s | done |")
    print("|---|---|---|---|---|---|---|")
    for name, make, options in CASES:
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
            f"| {name} | {len(mesh.faces)} | {quality['tetrahedra']} | {shape} | {filled.deviation_mm:.2f} mm | {seconds:.0f} | {'; '.join(filled.done)} |",
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


CASES: tuple[tuple[str, Callable[[], Any], dict[str, Any]], ...] = (
    ("capsule", lambda: trimesh.creation.capsule(80, 12, count=[48, 48]), {}),
    ("the same, finer", lambda: trimesh.creation.capsule(80, 12, count=[48, 48]), {"most_tets": 8000}),
    ("holes, turned triangles", torn, {}),
    ("a chamber, outward shell", chambered, {}),
    ("two blocks that cross", crossing, {}),
    ("open tube", tube, {}),
    ("open tube, --close-holes", tube, {"close_holes": True}),
    ("very fine", wavy, {}),
)

if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
