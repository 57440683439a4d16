"""The .usdz file: Pixar's own reader puts vertices where the .glb file has them, and its rules are kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from glb import Glb, in_gltf
from xr_bar import bar_mesh, bar_states, bar_surface, write_run_with_mesh

from femsense.core.errors import InputError
from femsense.xr.export import export_glb
from femsense.xr.gltf import Texture, write_glb
from femsense.xr.skinning import fit_poses, fit_skin
from femsense.xr.usdz_export import TICKS, write_usdz

pytest.importorskip("pxr")
from pxr import Usd, UsdShade, UsdSkel, UsdValidation


def skinned(stage: Usd.Stage, time_code: float) -> np.ndarray:
    """Vertices of the mesh at a time, by UsdSkel, shape (V, 3)."""
    root = UsdSkel.Root(stage.GetDefaultPrim())
    cache = UsdSkel.Cache()
    cache.Populate(root, Usd.PrimDefaultPredicate)
    (binding,) = cache.ComputeSkelBindings(root, Usd.PrimDefaultPredicate)
    (target,) = binding.GetSkinningTargets()
    pose = cache.GetSkelQuery(binding.GetSkeleton()).ComputeSkinningTransforms(Usd.TimeCode(time_code))
    points = target.GetPrim().GetAttribute("points").Get()
    assert target.ComputeSkinnedPoints(pose, points)
    return np.array(points)


def test_vertices_move_as_in_the_glb_file(tmp_path: Path) -> None:
    run = write_run_with_mesh(tmp_path / "bar", bones=9)
    report = export_glb(run, tmp_path / "out" / "bar.usdz", bones=9)
    export_glb(run, tmp_path / "bar.glb", bones=9)
    glb, stage = Glb(tmp_path / "bar.glb"), Usd.Stage.Open(str(report.path))
    assert (stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond(), report.bones) == (pytest.approx(2.0 * TICKS), TICKS, 9)
    for k in (0, 5, 23):
        np.testing.assert_allclose(skinned(stage, float(glb.times[k]) * TICKS), glb.vertices(k), atol=2e-6)
    _, states = bar_states(bar_mesh().nodes)
    bent = skinned(stage, float(glb.times[5]) * TICKS)
    assert np.ptp(bent[:, 1]) == pytest.approx(np.ptp(in_gltf(states[5])[:, 1]), rel=0.02)  # upright, in metres


@pytest.mark.parametrize("look", ["plain", "vertices", "image"])
def test_pixars_rules_are_kept(tmp_path: Path, look: str) -> None:
    rest, surface, triangles = bar_surface(4)
    times = np.arange(4.0)
    skin = fit_skin(rest, surface, bones=5)
    across = (rest[:, [0, 2]] - rest[:, [0, 2]].min(axis=0)) / np.ptp(rest[:, [0, 2]], axis=0)
    colors = np.column_stack([across, across[:, :1]])
    png = bytes.fromhex(
        "89504e470d0a1a0a0000000d49484452000000010000000108020000009077"
        "53de0000000c4944415408d763f8cfc0000003010100c9fe92ef0000000049454e44ae426082"
    )
    texture = Texture(across, png) if look == "image" else None
    color = colors if look == "vertices" else [0.9, 0.3, 0.1]
    glb = write_glb(
        tmp_path / "b.glb",
        rest,
        triangles,
        skin,
        fit_poses(skin, surface),
        times,
        color_rgb=color,
        texture=texture,
        name="2 bars",
    )
    file = write_usdz(glb.read_bytes(), tmp_path / "b.usdz")
    stage = Usd.Stage.Open(str(file))
    rules = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(rules) > 20
    assert [error.GetErrorAsString() for error in UsdValidation.ValidationContext(rules).Validate(stage)] == []
    shader = UsdShade.Shader(stage.GetPrimAtPath("/_2_bars/look/surface"))
    diffuse = shader.GetInput("diffuseColor")
    if look == "plain":
        assert diffuse.Get()[0] == pytest.approx(((0.9 + 0.055) / 1.055) ** 2.4)
        return
    source, _, _ = diffuse.GetConnectedSource()
    assert source.GetPrim().GetName() == {"vertices": "colors", "image": "image"}[look]
    if look == "image":
        st = np.array(stage.GetPrimAtPath("/_2_bars/body").GetAttribute("primvars:st").Get())
        np.testing.assert_allclose(st[:, 1], 1 - across[:, 1], atol=1e-6)


def test_what_is_no_mesh_of_femsense_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a mesh of femsense"):
        write_usdz(b"glTF", tmp_path / "b.usdz")
    assert list(tmp_path.iterdir()) == []
