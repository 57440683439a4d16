"""robot.toml ↔ Robot: the declared robot, with checks whose errors name file and key."""

from __future__ import annotations

import copy
import shutil
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import femsense
from femsense.core.errors import InputError
from femsense.core.text import did_you_mean
from femsense.fem.body_parts import Cable
from femsense.fem.mesh import TetMesh
from femsense.io.correction_file import read_correction, write_correction
from femsense.io.files import plain, write_beside, write_toml
from femsense.io.mesh_files import mesh_companions, write_mesh
from femsense.io.robot_body import boxes_around, build_robot
from femsense.io.robot_tables import FORMAT, RobotTable, robot_problems, table_problems
from femsense.io.tables import at_key, beside, read_toml, validated
from femsense.model.robot import MarkerLook, Robot, plain_actuation

# Loading


def load_robot(path_or_name: str | Path, *, effects: bool = True) -> Robot:
    """Load a robot: its mesh, material, cables, chambers and markers, and the effects of its model.

    Arguments:
        path_or_name: a folder with robot.toml, that file, or the name of a robot of the package (`robot_names`).
        effects: whether to apply the physical effects that the file declares under `[[effects]]` (cable friction, creep, …). Default: yes.

    Returns:
        the robot, with its mesh in metres in the robot frame.

    Raises:
        InputError: the file is missing or invalid; the error states the key, the value found and the values expected.

    Example:
        >>> import femsense as fs
        >>> robot = fs.load_robot("finger")
        >>> robot.name, robot.body.cable_names
        ('finger', ('flexor',))
    """
    path = find_robot(path_or_name)
    document = read_toml(path)
    table = validated(RobotTable, document, path)
    for problem in table_problems(table, path):
        raise problem
    robot = build_robot(table, document, path)
    if not effects:
        return robot
    robot = _with_effects(robot, [dict(entry) for entry in table.effects], path)
    return robot if table.correction is None else replace(robot, correction=read_correction(beside(path, table.correction.file)))


def find_robot(path_or_name: str | Path) -> Path:
    """Return the robot.toml of a folder, a file or a NAME. Raises InputError that lists the known names."""
    path = Path(path_or_name).expanduser()
    known = robot_names()
    if path.is_file():
        return path
    if (path / "robot.toml").is_file():
        if str(path_or_name) in known and known[str(path_or_name)].resolve() != path.resolve():
            warnings.warn(
                (
                    f"{path_or_name}: the folder {path.absolute()} is used; the robot of that name in the package is "
                    f"{known[str(path_or_name)]}"
                ),
                stacklevel=3,
            )
        return path / "robot.toml"
    if str(path_or_name) in known:
        if path.exists():
            warnings.warn(
                f"{path_or_name}: the robot of the package is used; the folder {path.absolute()} has no robot.toml",
                stacklevel=3,
            )
        return known[str(path_or_name)] / "robot.toml"
    if path.is_dir():
        raise InputError("not a robot: the folder has no robot.toml", where=path, found=_listing(path), expected="robot.toml")
    names = ", ".join(sorted(known)) or "none"
    raise InputError(
        "no such robot",
        where=path_or_name,
        found="neither a folder, nor a file, nor a known name",
        expected=f"a folder with robot.toml, or one of: {names}",
        hint=did_you_mean(str(path_or_name), known),
    )


def robot_names() -> dict[str, Path]:
    """Return the robots that are installed with femsense: name → folder.

    Example:
        >>> import femsense as fs
        >>> sorted(fs.robot_names())
        ['arm', 'finger', 'four-leg', 'gripper', 'pneu-finger']
    """
    package = Path(femsense.__file__).parent
    folders: dict[str, Path] = {}
    for root in (package.parent / "meshes", package / "meshes"):
        found = sorted(root.iterdir()) if root.is_dir() else []
        folders.update({folder.name: folder for folder in found if (folder / "robot.toml").is_file()})
    return folders


def _with_effects(robot: Robot, entries: list[dict[str, Any]], path: Path) -> Robot:
    from femsense.model.effects import apply_effects

    for i, entry in enumerate(entries):
        try:
            robot = apply_effects(robot, [entry])
        except InputError as error:
            name = entry["name"]
            raise InputError(
                f"effect {name!r}: {error.what}",
                where=at_key(path, "effects", i),
                found=error.found,
                expected=error.expected,
                hint=error.hint,
            ) from None
    return robot


# Saving


def save_robot(robot: Robot, folder: str | Path, *, effects: Sequence[Mapping[str, Any]] | None = None) -> Path:
    """Write robot.toml and a copy of the mesh file, so that the folder loads back to the same robot.

    A loaded robot is written as it was declared; changes made in Python since then must be given as `effects`. Its correction is written too.

    Arguments:
        robot: the robot.
        folder: created if missing; its other files are kept.
        effects: list of dicts to write as `[[effects]]`, each with `name` and the parameters of an effect. Default: those that the robot declares.

    Returns:
        the path of robot.toml.

    Raises:
        InputError: the robot was made in Python and has properties that robot.toml can only express by effects.

    Example:
        >>> import tempfile
        >>> import femsense as fs
        >>> path = fs.save_robot(fs.load_robot("finger"), tempfile.mkdtemp(), effects=[{"name": "stiffness", "scale": 0.9}])
        >>> fs.load_robot(path).document["effects"]
        [{'name': 'stiffness', 'scale': 0.9}]
    """
    target = Path(folder)
    document = robot_document(robot, effects=effects)
    document.pop("correction", None)
    if robot.correction is not None:
        document["correction"] = {"file": write_correction(robot.correction, target)}
    for entry in document.get("effects", []):
        if "file" in entry:
            entry["file"] = _copy_effect(entry, robot, target)
    if robot.document is not None and robot.folder is not None:
        document["mesh"]["file"] = _copy_mesh(beside(robot.folder / "robot.toml", document["mesh"]["file"]), target)
    else:
        write_mesh(robot.body.mesh, target / document["mesh"]["file"])
    write_toml(target / "robot.toml", document)
    return target / "robot.toml"


def robot_document(robot: Robot, *, effects: Sequence[Mapping[str, Any]] | None = None) -> dict[str, Any]:
    """Return the robot as the plain tables of robot.toml; see `save_robot`."""
    document = copy.deepcopy(robot.document) if robot.document is not None else _declared(robot)
    document["name"] = robot.name
    if effects is not None:
        document["effects"] = [plain(dict(entry), nonfinite=True) for entry in effects]
    if not document.get("effects"):
        document.pop("effects", None)
    problems = robot_problems(document, Path("robot.toml"))
    if problems:
        raise problems[0]
    return document


def _declared(robot: Robot) -> dict[str, Any]:
    """Return the tables of a robot that was made in Python."""
    body = robot.body
    _check_plain(robot)
    document: dict[str, Any] = {
        "format": FORMAT,
        "name": robot.name,
        "mesh": {"file": "mesh.vtu", "unit": "m", "element": "tet10" if body.mesh.is_quadratic else "tet4"},
        "material": {
            "young_modulus_pa": float(body.material.young_modulus[0]),
            "poisson_ratio": float(body.material.poisson_ratio[0]),
            "density_kg_m3": body.material.density,
        },
    }
    if body.gravity.any():
        document["gravity"] = {"vector_m_s2": body.gravity.tolist()}
    if not len(body.clamped):
        raise InputError("the body has no clamp", where="robot", expected="clamped nodes")
    document["fixed"] = [{"box_m": box.tolist()} for box in boxes_around(body.mesh.nodes, body.clamped)]
    document["cables"] = [_cable_document(cable, body.mesh) for cable in body.cables]
    document["chambers"] = [{"name": c.name, "seed_m": c.seed.tolist(), "max_pressure_pa": c.max_pressure} for c in body.chambers]
    looks = {look.name: look for look in robot.marker_looks}
    document["markers"] = [
        {"name": n, "position_m": p.tolist(), **_look_document(looks.get(n))}
        for n, p in zip(robot.marker_names, robot.marker_points)
    ]
    document["features"] = {"count": max(len(robot.features), 1)}
    if robot.color_rgb is not None:
        document["appearance"] = {"color_rgb": robot.color_rgb.tolist()}
    if any(look.aruco_id is not None for look in robot.marker_looks):
        document.setdefault("appearance", {})["aruco_dictionary"] = robot.aruco_dictionary
    return {key: value for key, value in document.items() if value != []}


def _look_document(look: MarkerLook | None) -> dict[str, Any]:
    if look is None:
        return {}
    tag = {} if look.aruco_id is None else {"aruco_id": look.aruco_id}
    return tag if look.color_rgb is None else {**tag, "color_rgb": look.color_rgb.tolist()}


def _check_plain(robot: Robot) -> None:
    """Refuse to write a robot made in Python whose model is not the plain one."""
    body, material = robot.body, robot.body.material
    plain_inputs = plain_actuation(len(body.cables))
    same_inputs = not robot.by_recording and all(
        np.array_equal(getattr(robot.actuation, name), getattr(plain_inputs, name)) for name in plain_inputs.__slots__
    )
    beyond = {
        "a material that varies": np.ptp(material.young_modulus) > 0 or np.ptp(material.poisson_ratio) > 0,
        f"the law {material.law}": material.law != "corotational",
        "a clamp that gives": np.isfinite(body.clamp_stiffness),
        "dead forces": body.dead_forces.any(),
        "masses that it carries": body.carried_mass is not None,
        "cable friction": any(cable.friction for cable in body.cables),
        "actuation that is not plain": not same_inputs,
        "observation that is not plain": (robot.observation.depth_scale, robot.observation.depth_offset) != (1.0, 0.0),
        "creep": robot.creep,
        "softness of what was loaded": robot.softening,
    }
    found = [name for name, holds in beyond.items() if holds]
    if found:
        raise InputError(
            "robot.toml cannot say this without effects",
            where=robot.name,
            found=", ".join(found),
            expected="the plain model",
            hint="save the plain robot and pass effects=[…]",
        )


def _cable_document(cable: Cable, mesh: TetMesh) -> dict[str, Any]:
    table: dict[str, Any] = {
        "name": cable.name,
        "path_m": cable.path.positions(mesh.nodes).tolist(),
        "pull_point_m": cable.pull_point.tolist(),
        "min_tension_n": cable.min_tension,
    }
    if cable.exit_direction is not None:
        table["exit_direction"] = cable.exit_direction.tolist()
    if np.isfinite(cable.max_tension):
        table["max_tension_n"] = cable.max_tension
    return table


def _copy_effect(entry: Mapping[str, Any], robot: Robot, folder: Path) -> str:
    """Copy the Python file of a user's effect and return its name."""
    from femsense.model.effects.user_defined import find_own_file

    source = find_own_file(entry, robot)
    if not source.is_file():
        raise InputError("the file of an effect is gone", where=source, expected=f"the Python file of {entry.get('name')}")
    target = folder / source.name
    if not (target.exists() and target.samefile(source)):
        with write_beside(target) as part:
            shutil.copyfile(source, part)
    return source.name


def _copy_mesh(source: Path, folder: Path) -> str:
    """Copy a mesh file (with the files that belong to it) and return its name."""
    if not source.is_file():
        raise InputError("the robot's mesh file is gone", where=source, expected="the file that it was loaded from")
    for file in mesh_companions(source):
        target = folder / file.name
        if not (target.exists() and target.samefile(file)):
            with write_beside(target) as part:
                shutil.copyfile(file, part)
    return source.name


def _listing(folder: Path) -> str:
    names = sorted(file.name for file in folder.iterdir())
    return ", ".join(names[:6]) + (", …" if len(names) > 6 else "") or "an empty folder"
