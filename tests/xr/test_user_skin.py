"""A surface of the user's own: carried by the elements, decimated to a budget, its colours and texture kept."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import trimesh
from glb import Glb, in_gltf
from PIL import Image
from xr_bar import bent, write_run

from femsense.app.cli import run as command
from femsense.core.errors import InputError
from femsense.xr.glb_reader import read_glb
from femsense.xr.run_contents import export_run, skin_for_run
from femsense.xr.user_skin import decimated, read_skin


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("run") / "bar", frames=12)


def tube(rings: int = 60) -> trimesh.Trimesh:
    """A round tube inside the square bar, as CAD would have it [mm]."""
    made = trimesh.creation.cylinder(radius=11.0, height=180.0, sections=32).subdivide_to_size(180.0 / rings)
    made.apply_translation([0.0, 0.0, 100.0])
    return made


def test_the_body_carries_it_where_the_elements_are(run: Path, tmp_path: Path) -> None:
    file = tmp_path / "tube.stl"
    tube().export(file)
    report = export_run(run, tmp_path / "robot.glb", bones=12, skin=skin_for_run(run, file, unit="mm"))
    back = read_glb((tmp_path / "robot.glb").read_bytes()).skin
    assert report.vertices == len(back.rest) and back.rest[:, 2].max() == pytest.approx(0.19, abs=1e-6)
    phase = 3 / 11
    wave = np.sin(2 * np.pi * phase)
    wanted = bent(back.rest, 11.0 * wave, 6.0 * np.sin(4 * np.pi * phase), 5.0 * np.sin(3 * np.pi * phase))
    off = Glb(tmp_path / "robot.glb").vertices(3) - in_gltf(wanted)
    moved = np.linalg.norm(wanted - back.rest, axis=1).max()
    rms = np.sqrt((off**2).sum(axis=1).mean())
    assert moved > 0.05 and rms < 0.02 * moved and report.rms_m < 1e-3  # elements of 1 cm and twelve bones


def test_colours_textures_and_budgets(run: Path, tmp_path: Path) -> None:
    red = tube(80)
    red.visual.vertex_colors = np.where(red.vertices[:, 2:] > 100.0, [[255, 0, 0, 255]], [[0, 0, 255, 255]]).astype(np.uint8)
    red.export(tmp_path / "red.ply")
    full = read_skin(tmp_path / "red.ply", unit="mm")
    small = decimated(full, 400)
    assert len(full.rest) > 1000 and 200 < len(small.rest) <= 400 and small.colors is not None
    high = small.rest[:, 2] > 0.11
    np.testing.assert_array_equal(small.colors[high], np.tile([1.0, 0.0, 0.0], (high.sum(), 1)))
    np.testing.assert_allclose(np.ptp(small.rest, axis=0), np.ptp(full.rest, axis=0), rtol=0.02)

    image = Image.fromarray(np.array([[[0, 255, 0]], [[255, 0, 0]]], dtype=np.uint8))  # green above red
    skin = tube(20)
    uv = np.column_stack([np.full(len(skin.vertices), 0.5), (skin.vertices[:, 2] - 10.0) / 180.0])  # trimesh counts from below
    skin.visual = trimesh.visual.TextureVisuals(uv, trimesh.visual.material.PBRMaterial(baseColorTexture=image))
    skin.apply_transform(np.diag([1e-3, 1e-3, 1e-3, 1.0]))
    skin.apply_transform(np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]))  # glTF: metres, Y up
    skin.export(tmp_path / "skin.glb")
    export_run(run, tmp_path / "out.glb", bones=4, skin=skin_for_run(run, tmp_path / "skin.glb"))
    glb = Glb(tmp_path / "out.glb")
    assert glb.attribute("POSITION")[:, 1].max() == pytest.approx(0.19, abs=1e-6)
    high = glb.attribute("POSITION")[:, 1] > 0.15
    view = glb.json["bufferViews"][glb.json["images"][0]["bufferView"]]
    kept = Image.open(io.BytesIO(glb.binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]))
    assert kept.getpixel((0, 0)) == (0, 255, 0) and (glb.attribute("TEXCOORD_0")[high, 1] < 0.5).all()
    baked = read_skin(tmp_path / "skin.glb", budget=150)
    assert baked.texture is None and baked.colors is not None and len(baked.rest) <= 150
    np.testing.assert_allclose(
        baked.colors[baked.rest[:, 2] > 0.15], np.tile([0.0, 1.0, 0.0], ((baked.rest[:, 2] > 0.15).sum(), 1))
    )


def test_what_does_not_lie_on_the_body_is_refused(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tube().export(tmp_path / "tube.stl")
    with pytest.raises(InputError, match="unit of the skin"):
        skin_for_run(run, tmp_path / "tube.stl")
    with pytest.raises(InputError, match=r"does not lie on the body[\s\S]*2.2e\+04 × 2.2e\+04 × 1.8e\+05 mm"):
        export_run(run, tmp_path / "x.glb", skin=skin_for_run(run, tmp_path / "tube.stl", unit="m"))
    (tmp_path / "broken.stl").write_bytes(b"nothing")
    with pytest.raises(InputError, match="skin"):
        skin_for_run(run, tmp_path / "broken.stl", unit="mm")
    out = str(tmp_path / "cli.glb")
    given = ["export", str(run), "-o", out, "--bones", "4", "--skin", str(tmp_path / "tube.stl"), "--skin-unit", "mm"]
    assert command([*given, "--vertices", "300"]) == 0 and len(Glb(Path(out)).attribute("POSITION")) <= 300
    assert command(["export", str(run), "-o", out, "--skin", str(tmp_path / "no.stl"), "--skin-unit", "mm"]) == 2
    assert "no such file" in capsys.readouterr().err
