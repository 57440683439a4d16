"""The skinned, animated mesh as `.usdz`, which iPhones, iPads and Vision Pro open in AR without a page or an app.

It is the content of the `.glb` file, number for number: UsdSkel's joints are its bones, all at the top of their skeleton.
Reference: Pixar, Universal Scene Description, UsdSkel and UsdPreviewSurface; usdz file format specification 1.3.
"""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.errors import InputError
from femsense.core.packages import needed
from femsense.io.files import write_beside
from femsense.xr.glb_reader import AnimatedSkin, Surface, read_glb, read_surface
from femsense.xr.gltf import T_GLTF_ROBOT, quaternions

TICKS = 60.0
"""Time codes a second."""
ROUGHNESS = 0.55


def write_usdz(glb: bytes, path: str | Path) -> Path:
    """Write the content of a `.glb` file of femsense as `.usdz`, under a temporary name that is renamed at the end.

    Arguments:
        glb: content of the file that `export_glb` wrote.
        path: the `.usdz` file.

    Returns:
        the path.

    Raises:
        InputError: not a mesh of femsense. MissingDependency: without the extra usd.
    """
    usd = {
        name: needed(f"pxr.{name}", "usd", "writing .usdz")
        for name in ("Gf", "Sdf", "Usd", "UsdGeom", "UsdShade", "UsdSkel", "UsdUtils", "Vt")
    }
    animated, surface = read_glb(glb), read_surface(glb)
    with tempfile.TemporaryDirectory(prefix="femsense-usdz-") as folder, write_beside(path) as part:
        layer = Path(folder, "robot.usdc")
        stage = usd["Usd"].Stage.CreateNew(str(layer))
        root = _describe(usd, stage, surface.name, float(animated.time_s[-1]))
        mesh = _add_mesh(usd, stage, root, surface)
        _add_material(usd, stage, root, mesh, surface, Path(folder))
        _add_bones(usd, stage, root, mesh, animated)
        stage.Save()
        del stage
        if not usd["UsdUtils"].CreateNewARKitUsdzPackage(usd["Sdf"].AssetPath(str(layer)), str(part)):
            raise InputError("the package could not be written", where=path, hint="try another folder")
    return Path(path)


def _describe(usd: dict[str, Any], stage: Any, name: str, end_s: float) -> Any:
    """Set units and times; return the skeleton's root, the default prim of the file."""
    usd["UsdGeom"].SetStageUpAxis(stage, usd["UsdGeom"].Tokens.y)
    usd["UsdGeom"].SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(TICKS)
    stage.SetFramesPerSecond(TICKS)
    stage.SetStartTimeCode(0.0)
    stage.SetEndTimeCode(end_s * TICKS)
    root = usd["UsdSkel"].Root.Define(stage, "/" + _identifier(name))
    stage.SetDefaultPrim(root.GetPrim())
    return root


def _add_mesh(usd: dict[str, Any], stage: Any, root: Any, surface: Surface) -> Any:
    vt, geom = usd["Vt"], usd["UsdGeom"]
    mesh = geom.Mesh.Define(stage, root.GetPath().AppendChild("body"))
    mesh.CreatePointsAttr(vt.Vec3fArray.FromNumpy(surface.points))
    mesh.CreateFaceVertexCountsAttr(vt.IntArray.FromNumpy(np.full(len(surface.triangles), 3, dtype=np.int32)))
    mesh.CreateFaceVertexIndicesAttr(vt.IntArray.FromNumpy(surface.triangles.ravel().astype(np.int32)))
    mesh.CreateNormalsAttr(vt.Vec3fArray.FromNumpy(surface.normals))
    mesh.SetNormalsInterpolation(geom.Tokens.vertex)
    mesh.CreateSubdivisionSchemeAttr(geom.Tokens.none)
    mesh.CreateExtentAttr(geom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get()))
    each = surface.colors is not None
    shown = surface.colors if surface.colors is not None else surface.color[None]
    color = mesh.CreateDisplayColorPrimvar(geom.Tokens.vertex if each else geom.Tokens.constant)
    color.Set(vt.Vec3fArray.FromNumpy(np.ascontiguousarray(shown)))
    if surface.uv is not None:
        kind = usd["Sdf"].ValueTypeNames.TexCoord2fArray
        places = geom.PrimvarsAPI(mesh).CreatePrimvar("st", kind, geom.Tokens.vertex)
        places.Set(
            vt.Vec2fArray.FromNumpy(np.column_stack([surface.uv[:, 0], 1.0 - surface.uv[:, 1]]))
        )  # from the lower left corner
    return mesh


def _add_material(usd: dict[str, Any], stage: Any, root: Any, mesh: Any, surface: Surface, folder: Path) -> None:
    shade, types = usd["UsdShade"], usd["Sdf"].ValueTypeNames
    path = root.GetPath().AppendChild("look")
    material, shader = shade.Material.Define(stage, path), shade.Shader.Define(stage, path.AppendChild("surface"))
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("roughness", types.Float).Set(ROUGHNESS)
    shader.CreateInput("metallic", types.Float).Set(0.0)
    diffuse = shader.CreateInput("diffuseColor", types.Color3f)
    if surface.png is not None:
        Path(folder, "look.png").write_bytes(surface.png)
        image = shade.Shader.Define(stage, path.AppendChild("image"))
        image.CreateIdAttr("UsdUVTexture")
        image.CreateInput("file", types.Asset).Set(usd["Sdf"].AssetPath("look.png"))
        places = _reader(usd, stage, path.AppendChild("places"), "st", "UsdPrimvarReader_float2", types.Float2)
        image.CreateInput("st", types.Float2).ConnectToSource(places)
        diffuse.ConnectToSource(image.CreateOutput("rgb", types.Float3))
    elif surface.colors is not None:
        reader = _reader(usd, stage, path.AppendChild("colors"), "displayColor", "UsdPrimvarReader_float3", types.Float3)
        diffuse.ConnectToSource(reader)
    else:
        diffuse.Set(usd["Gf"].Vec3f(*(float(v) for v in surface.color)))
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    shade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)


def _reader(usd: dict[str, Any], stage: Any, path: Any, variable: str, kind: str, result: Any) -> Any:
    reader = usd["UsdShade"].Shader.Define(stage, path)
    reader.CreateIdAttr(kind)
    reader.CreateInput("varname", usd["Sdf"].ValueTypeNames.String).Set(variable)
    return reader.CreateOutput("result", result)


def _add_bones(usd: dict[str, Any], stage: Any, root: Any, mesh: Any, animated: AnimatedSkin) -> None:
    """Add skeleton, weights and animation.

    Joints have no parents, so that their poses are those of the bones in the file's frame.
    """
    skel, vt, skin = usd["UsdSkel"], usd["Vt"], animated.skin
    skeleton = skel.Skeleton.Define(stage, root.GetPath().AppendChild("skeleton"))
    names = [f"bone_{k}" for k in range(len(skin.skeleton))]
    rest = _matrices(usd, T_GLTF_ROBOT @ skin.skeleton.T_robot_bone)
    skeleton.CreateJointsAttr(names)
    skeleton.CreateBindTransformsAttr(rest)
    skeleton.CreateRestTransformsAttr(rest)
    binding = skel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    width = skin.weights.shape[1]
    binding.CreateJointIndicesPrimvar(False, width).Set(vt.IntArray.FromNumpy(skin.joints.ravel().astype(np.int32)))
    binding.CreateJointWeightsPrimvar(False, width).Set(vt.FloatArray.FromNumpy(skin.weights.ravel().astype(np.float32)))
    motion = skel.Animation.Define(stage, skeleton.GetPath().AppendChild("run"))
    motion.CreateJointsAttr(names)
    motion.CreateScalesAttr(vt.Vec3hArray.FromNumpy(np.ones((len(names), 3), dtype=np.float16)))
    places, turns = _moved(animated)
    for t, at, turned in zip(animated.time_s, places, turns):
        code = usd["Usd"].TimeCode(float(t) * TICKS)
        motion.CreateTranslationsAttr().Set(vt.Vec3fArray.FromNumpy(at), code)
        motion.CreateRotationsAttr().Set(
            vt.QuatfArray([usd["Gf"].Quatf(float(w), float(x), float(y), float(z)) for x, y, z, w in turned]), code
        )
    skel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([motion.GetPath()])


def _moved(animated: AnimatedSkin) -> tuple[Any, Any]:
    """Return places (F, B, 3) and quaternions x y z w (F, B, 4) of the bones in glTF's frame."""
    from scipy.spatial.transform import Rotation

    R, rows = T_GLTF_ROBOT[:3, :3], animated.bones.astype(np.float64)
    turned = R @ Rotation.from_quat(rows[..., 3:].reshape(-1, 4)).as_matrix()
    places = np.ascontiguousarray(rows[..., :3] @ R.T, dtype=np.float32)
    return places, quaternions(turned.reshape(*rows.shape[:2], 3, 3))


def _matrices(usd: dict[str, Any], T: Any) -> Any:
    """Return poses (B, 4, 4) as USD has them: for row vectors."""
    return usd["Vt"].Matrix4dArray([usd["Gf"].Matrix4d(matrix.T.tolist()) for matrix in T])


def _identifier(name: str) -> str:
    word = re.sub(r"\W", "_", name, flags=re.ASCII)
    return word if re.match(r"[A-Za-z_]", word) else f"_{word}"
