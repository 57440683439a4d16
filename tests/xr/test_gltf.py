"""The GLB file: what it means (read by a reader of its own), what Khronos' validator says, refusals."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from glb import Glb, build_hook, in_gltf, npm_folder
from helpers import write_block_robot
from scipy.spatial.transform import Rotation
from small_run import make_run
from xr_bar import bar_mesh, bar_states, bar_surface

from femsense.core.errors import InputError
from femsense.fem.mesh import surface_triangles, to_quadratic, triangle_normals
from femsense.io.robot_toml import load_robot
from femsense.xr.export import export_glb
from femsense.xr.glb_reader import parts_of, read_glb
from femsense.xr.gltf import ExportReport, export_states, quaternions, write_glb
from femsense.xr.skinning import fit_poses, fit_skin

VALIDATOR = "gltf-validator@2.0.0-dev.3.10"


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Glb, ExportReport, np.ndarray]:
    mesh = bar_mesh()
    times, states = bar_states(mesh.nodes)
    path = tmp_path_factory.mktemp("glb") / "bar.glb"
    report = export_states(mesh.nodes, mesh.tets, times, states.astype(np.float32), path, bones=10)
    return Glb(path), report, states[:, np.unique(surface_triangles(mesh))]


# ---- what the file means ---------------------------------------------------------------------------------------------------


def test_skinned_vertices_are_where_the_surface_is(exported: tuple[Glb, ExportReport, np.ndarray]) -> None:
    glb, report, surface = exported
    off = np.array([glb.vertices(f) for f in range(len(surface))]) - in_gltf(surface)
    rms = float(np.sqrt((off**2).sum(axis=-1).mean()))
    assert rms == pytest.approx(report.rms_m, rel=1e-3)
    assert np.sqrt((off**2).sum(axis=-1)).max() == pytest.approx(report.max_m, rel=1e-2)
    motion = np.sqrt(((surface - surface[0]) ** 2).sum(axis=-1).mean())
    assert report.rms_m < 0.01 * motion  # the report itself cannot hide a mesh in the wrong place
    assert (report.frames, report.vertices, report.bones) == (len(surface), surface.shape[1], 10)


def test_bind_pose_is_the_rest_shape_upright(exported: tuple[Glb, ExportReport, np.ndarray]) -> None:
    glb, _, surface = exported
    np.testing.assert_allclose(glb.vertices(None), glb.attribute("POSITION"), atol=1e-7)
    np.testing.assert_allclose(glb.attribute("POSITION"), in_gltf(surface[0]), atol=1e-7)
    assert np.ptp(glb.attribute("POSITION")[:, 1]) == pytest.approx(0.2, rel=1e-5)  # 0.2 m tall, y up


def test_normals_point_outward(exported: tuple[Glb, ExportReport, np.ndarray]) -> None:
    glb, _, _ = exported
    primitive = glb.json["meshes"][0]["primitives"][0]
    triangles = glb.array(primitive["indices"]).reshape(-1, 3).astype(int)
    points, normals = glb.attribute("POSITION").astype(float), glb.attribute("NORMAL").astype(float)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    face = triangle_normals(points, triangles)
    assert ((face * normals[triangles].mean(axis=1)).sum(axis=1) > 0).all()
    volume = np.einsum("ti,ti->", face, points[triangles].mean(axis=1)) / 3.0
    assert volume == pytest.approx(0.03 * 0.03 * 0.2, rel=1e-5)


def test_keys_start_at_zero_and_do_not_jump(exported: tuple[Glb, ExportReport, np.ndarray]) -> None:
    glb, _, _ = exported
    assert glb.times[0] == 0.0 and glb.times[-1] == pytest.approx(2.0) and (np.diff(glb.times) > 0).all()
    animation = glb.json["animations"][0]
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        assert sampler["interpolation"] == "LINEAR"
        if channel["target"]["path"] == "rotation":
            q = glb.array(sampler["output"]).astype(float)
            np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-6)
            assert ((q[1:] * q[:-1]).sum(axis=1) > 0).all()


def test_quaternions_pass_half_a_turn_without_a_jump() -> None:
    from scipy.spatial.transform import Rotation

    angle = np.linspace(0.0, 6.0 * np.pi, 61)
    turns = Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0]).as_matrix()[:, None]
    q = quaternions(turns)[:, 0]
    assert ((q[1:] * q[:-1]).sum(axis=1) > 0.9).all()
    np.testing.assert_allclose(Rotation.from_quat(q).as_matrix(), turns[:, 0], atol=1e-12)


def test_joints_and_weights_follow_the_rules(exported: tuple[Glb, ExportReport, np.ndarray]) -> None:
    glb, report, _ = exported
    joints, weights = glb.attribute("JOINTS_0"), glb.attribute("WEIGHTS_0")
    assert joints.dtype == np.uint8 and joints.shape[1] == 4 and joints.max() < report.bones
    np.testing.assert_allclose(weights.astype(float).sum(axis=1), 1.0, atol=1e-7)
    assert (joints[weights == 0] == 0).all()
    skin = glb.json["skins"][0]
    assert glb.json["nodes"][skin["skeleton"]]["children"] == skin["joints"]
    assert "rotation" not in glb.json["nodes"][0] and glb.json["scenes"][0]["nodes"] == [0, 1]


def test_single_frame_and_quadratic_mesh(tmp_path: Path) -> None:
    mesh = to_quadratic(bar_mesh((1, 1, 6)))
    _, states = bar_states(mesh.nodes, 9)
    report = export_states(None, mesh.tets, [7.5], states[4:5], tmp_path / "one.glb")
    glb = Glb(tmp_path / "one.glb")
    assert list(glb.times) == [0.0]
    used = np.unique(surface_triangles(mesh))
    np.testing.assert_allclose(glb.vertices(0), in_gltf(states[4, used]), atol=1e-6)
    assert report.rms_m < 1e-9


def test_colours(tmp_path: Path) -> None:
    rest, states, triangles = bar_surface(3, (1, 1, 4))
    skin = fit_skin(rest, states, bones=2)
    poses = fit_poses(skin, states)
    write_glb(tmp_path / "a.glb", rest, triangles, skin, poses, [0, 1, 2], color_rgb=(1.0, 0.5, 0.0))
    factor = Glb(tmp_path / "a.glb").json["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"]
    assert factor == pytest.approx([1.0, 0.2140, 0.0, 1.0], abs=1e-4)  # sRGB 0.5 is 0.214 in linear light
    each = np.linspace(0.0, 1.0, rest.size).reshape(rest.shape)
    write_glb(tmp_path / "b.glb", rest, triangles, skin, poses, [0, 1, 2], color_rgb=each)
    assert Glb(tmp_path / "b.glb").attribute("COLOR_0").shape == rest.shape


def test_times_far_from_zero_keep_their_steps(tmp_path: Path) -> None:
    rest, states, triangles = bar_surface(3, (1, 1, 4))
    skin = fit_skin(rest, states, bones=2)
    start = 1.7e9  # seconds since 1970: too coarse for single precision unless the first is taken off
    path = write_glb(tmp_path / "t.glb", rest, triangles, skin, fit_poses(skin, states), start + np.array([0.0, 0.033, 0.066]))
    np.testing.assert_allclose(Glb(path).times, [0.0, 0.033, 0.066], atol=1e-6)


# ---- refusals ----------------------------------------------------------------------------------------------------------------


def test_refusals_leave_nothing_behind(tmp_path: Path) -> None:
    mesh = bar_mesh((1, 1, 4))
    times, states = bar_states(mesh.nodes, 4)
    broken = states.copy()
    broken[2, 0] = np.inf
    target = tmp_path / "robot.glb"
    for arguments, text in [
        ((mesh.nodes, mesh.tets, times, broken), r"states\[2\].*must be finite"),
        ((mesh.nodes, mesh.tets, times[[0, 2, 1, 3]], states), r"time_s\[2\].*must increase"),
        ((mesh.nodes, mesh.tets, times[[0, 1, 1, 2]], states), r"time_s\[2\].*must increase"),
        ((mesh.nodes, mesh.tets, times[:3], states), "one finite time a frame"),
        ((mesh.nodes, mesh.tets, times, states[:0]), "wrong shape"),
        ((mesh.nodes[:-1], mesh.tets, times, states), "tets names a node"),
    ]:
        with pytest.raises(InputError, match=text):
            export_states(*arguments, target, bones=2)
    with pytest.raises(InputError, match="not a colour"):
        export_states(mesh.nodes, mesh.tets, times, states, target, bones=2, color_rgb=(20, 110, 200))
    with pytest.raises(InputError, match="folder does not exist"):
        export_states(mesh.nodes, mesh.tets, times, states, tmp_path / "no" / "robot.glb", bones=2)
    assert list(tmp_path.iterdir()) == []


# ---- forces ------------------------------------------------------------------------------------------------------------------


def test_arrows_end_where_forces_act_point_along_them_and_are_gone_where_there_is_none(tmp_path: Path) -> None:
    run = make_run(load_robot(write_block_robot(tmp_path / "robot")))
    sure = replace(run.contacts[2], force_std_n_xyz=np.array([0.1, 0.2, 0.3]), position_std_m=np.array([1e-3, 2e-3, 3e-3]))
    run = replace(run, contacts=(*run.contacts[:2], sure))
    export_glb(run, tmp_path / "forces.glb", bones=3, arrows=True)
    file = (tmp_path / "forces.glb").read_bytes()
    document, binary = parts_of(file)
    nodes, animation = document["nodes"], document["animations"][0]
    assert nodes[1]["children"][-1] == nodes.index(next(n for n in nodes if n["name"] == "forces"))

    def keys(name: str, path: str) -> np.ndarray:
        (channel,) = (
            c for c in animation["channels"] if nodes[c["target"]["node"]]["name"] == name and c["target"]["path"] == path
        )
        accessor = document["accessors"][animation["samplers"][channel["sampler"]]["output"]]
        begin = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        return np.frombuffer(binary, "<f4", 3 * (3 + (path == "rotation")), begin).reshape(3, -1)

    largest = max(np.linalg.norm(one.force_n_xyz) for one in run.contacts)
    size = np.linalg.norm(np.ptp(run.states.rest_nodes_m, axis=0))
    for name, index, there in (("contact_1", 0, [0, 1, 1]), ("contact_2", 1, [0, 1, 0])):
        one = run.contacts[index]
        length = 0.42 * size * np.linalg.norm(one.force_n_xyz) / largest
        np.testing.assert_allclose(keys(f"{name}_arrow", "translation")[1], one.position_m, atol=1e-6)
        way = Rotation.from_quat(keys(f"{name}_arrow", "rotation")[1]).apply([0.0, 1.0, 0.0])
        np.testing.assert_allclose(way * np.linalg.norm(one.force_n_xyz), one.force_n_xyz, atol=1e-5)
        scale = keys(f"{name}_arrow", "scale")
        np.testing.assert_allclose(scale[1], length, rtol=1e-5)
        assert (scale.any(axis=1) == np.array(there, dtype=bool)).all()
    np.testing.assert_allclose(keys("contact_1_place", "scale")[2], sure.position_std_m, rtol=1e-5)
    way = sure.force_n_xyz / np.linalg.norm(sure.force_n_xyz)
    across = np.linalg.norm(sure.force_std_n_xyz) ** 2 - np.linalg.norm(sure.force_std_n_xyz * way) ** 2
    np.testing.assert_allclose(keys("contact_1_direction", "scale")[2, 0], 0.42 * size / largest * np.sqrt(across / 2), rtol=1e-5)
    export_glb(run, tmp_path / "plain.glb", bones=3)
    np.testing.assert_array_equal(read_glb(file).bones, read_glb((tmp_path / "plain.glb").read_bytes()).bones)
    with pytest.raises(InputError, match=r"arrows are supported in \.glb files only"):
        export_glb(run, tmp_path / "forces.usdz", arrows=True)


# ---- Khronos' validator --------------------------------------------------------------------------------------------------------

SCRIPT = """
const { validateBytes } = require('gltf-validator');
const data = new Uint8Array(require('fs').readFileSync(process.argv[2]));
validateBytes(data).then((r) => console.log(JSON.stringify(r.issues)), (e) => { console.error(e); process.exit(1); });
"""


def test_khronos_validator_finds_nothing(request: pytest.FixtureRequest, tmp_path: Path) -> None:
    folder = npm_folder(request.config.cache.mkdir("gltf-validator"), VALIDATOR)
    script = folder / "validate.cjs"
    script.write_text(SCRIPT, encoding="utf-8")
    mesh = bar_mesh((1, 1, 6))
    times, states = bar_states(mesh.nodes, 9)
    export_states(mesh.nodes, mesh.tets, times, states, tmp_path / "many.glb", bones=5)
    export_states(None, mesh.tets, [0.0], states[:1], tmp_path / "one.glb")
    rest, surface, triangles = bar_surface(3, (1, 1, 4))
    skin = fit_skin(rest, surface, bones=2)
    write_glb(
        tmp_path / "colours.glb", rest, triangles, skin, fit_poses(skin, surface), [0, 1, 2], color_rgb=0.5 * np.ones_like(rest)
    )
    run = make_run(load_robot(write_block_robot(tmp_path / "robot")))
    export_glb(run, tmp_path / "forces.glb", bones=3, arrows=True)
    for name in ("many", "one", "colours", "forces"):
        command = [*build_hook().node_command(), str(script), str(tmp_path / f"{name}.glb")]
        said = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout
        issues = json.loads(said)
        assert issues["messages"] == [], name
        assert issues["numErrors"] == issues["numWarnings"] == issues["numInfos"] == 0
