"""From a surface to a robot: tetrahedra of a wanted size, their quality, and a robot.toml to start from."""

from __future__ import annotations

import re
import tempfile
import tomllib
import warnings
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

import femsense
from femsense.core.arrays import FloatArray, IntArray
from femsense.core.errors import FemsenseError, InputError
from femsense.core.units import PER_METRE, length_unit
from femsense.fem.cavities import cavity_seeds
from femsense.fem.mesh import TetMesh
from femsense.io.files import check_target, file_hash, followed, write_json, write_text
from femsense.io.mesh_files import SURFACE_ENDINGS, read_triangles, write_mesh
from femsense.io.meshes.reading import read_content
from femsense.io.meshing.cad import CAD_READ, read_cad
from femsense.io.meshing.cad_filling import fill_cad
from femsense.io.meshing.filling import POOR, Filled, Mesher, Progress, fill
from femsense.io.meshing.options import MeshOptions
from femsense.io.meshing.quality import quality_report, quality_text
from femsense.io.meshing.surface import check_finite
from femsense.io.meshing.tetrahedra import tetrahedralise
from femsense.io.robot_body import LARGEST_BODY, SMALLEST_BODY, likely_unit
from femsense.io.robot_toml import load_robot

MESH_FILE, REPORT_FILE = "mesh.vtu", "mesh.json"
USUAL = (5e-3, 2.0)
"""Bodies smaller or larger than this [m] suggest a wrong unit."""
CAD_ENDINGS = (".x_t", ".x_b", ".sldprt", ".sldasm", ".ipt", ".f3d", ".fcstd", ".3dm")


def mesh_into(
    folder: str | Path,
    surface: str | Path,
    options: MeshOptions,
    *,
    say: Callable[[str], None],
    again: bool = False,
    progress: Progress | None = None,
    mesher: Mesher = tetrahedralise,
) -> dict[str, Any]:
    """Fill a surface with tetrahedra and write them into a robot's folder; return the report that mesh.json holds.

    A folder without robot.toml gets a starter file. An existing robot.toml is kept, and the new mesh replaces the old one.

    Arguments:
        folder: of the robot.
        surface: STL, OBJ, PLY, OFF, STEP, IGES, BREP, or triangles in a format that meshio reads.
        options: unit, size and repairs.
        say: called with one-line notes.
        again: repeat it even if the folder contains this result.
        progress: called with a description of each step.
        mesher: of the repaired surface.

    Raises:
        InputError: a surface that cannot be filled; a robot.toml that does not load with the new mesh, in which
            case nothing is written. MissingDependency: without pytetwild.
    """
    source, target = Path(surface).expanduser(), Path(folder).expanduser()
    _check_target(target)
    said = length_unit(options.unit, allowed=PER_METRE) if options.unit else None
    options = options if said is None else replace(options, unit=said.name)
    if source.suffix.lower() in CAD_READ and options.unit is None:
        options = replace(options, unit="mm")  # the file declares its unit, and is converted to this one
    points, triangles = read_any_surface(source, unit=options.unit or "mm")
    check_unit(points, options.unit, source)
    inputs = {"surface": source.name, "sha256": file_hash(source), "options": asdict(options)}
    if not again and (known := finished(target, inputs)):
        say(f"{target} contains this mesh already (--again repeats the meshing)")
        return known
    filled = fill_cad(source, points, triangles, options, progress=progress) if source.suffix.lower() in CAD_READ else None
    filled = filled or fill(points, triangles, options, where=str(source), progress=progress, mesher=mesher)
    report = mesh_report(filled, options) | {"inputs": inputs, "femsense": femsense.__version__}
    report["robot"] = _write_robot(target, filled.mesh, options, source)
    report["mesh_sha256"] = file_hash(target / report["robot"]["mesh_file"])
    write_json(target / REPORT_FILE, report)
    return report


# The surface


def read_any_surface(path: Path, *, unit: str = "mm") -> tuple[FloatArray, IntArray]:
    """Return points and triangles of a surface file in its unit, as they are; of a CAD file in the given one.

    Raises InputError.
    """
    if not path.is_file():
        raise InputError("no such surface", where=path, expected="an STL, OBJ, PLY or OFF file")
    if not path.stat().st_size:
        raise InputError("the file is empty", where=path, found="0 bytes", expected="an STL, OBJ, PLY or OFF file")
    if path.suffix.lower() in SURFACE_ENDINGS:
        return read_triangles(path)
    if path.suffix.lower() in CAD_READ:
        if unit not in PER_METRE:
            raise InputError("unknown unit", where="--unit", found=unit, expected=" | ".join(PER_METRE))
        return read_cad(path, unit)
    if path.suffix.lower() in CAD_ENDINGS:
        raise InputError(
            "a CAD file of a format that is not read",
            where=path,
            found=path.suffix,
            expected="STEP, IGES, BREP, STL, OBJ, PLY or OFF",
            hint="export it as STEP or STL from the CAD program",
        )
    content = read_content(path, str(path))
    points, cells = content.points, content.cells
    check_finite(points, str(path))
    if "triangle" not in cells or any(kind.startswith("tetra") for kind in cells):
        raise InputError(
            "not a surface",
            where=path,
            found=", ".join(sorted(cells)) or "no cells",
            expected="triangles",
            hint="a mesh of tetrahedra needs no meshing: name it in robot.toml",
        )
    return points, cells["triangle"]


def check_unit(points: FloatArray, unit: str | None, path: Path) -> None:
    """Refuse a missing unit and one that makes the body unlikely small or large; warn of a doubtful one."""
    extents = np.ptp(points, axis=0)
    size = float(extents.max())
    text = " × ".join(f"{value:.4g}" for value in extents)
    best = likely_unit(size)
    hint = f"--unit {best} makes it {1e3 * size / PER_METRE[best]:.4g} mm long" if best else "scale the surface"
    if unit is None:
        raise InputError(
            "a surface file does not contain its unit",
            where=path,
            found=f"extents of {text}",
            expected="--unit m, --unit cm or --unit mm",
            hint=hint,
        )
    if unit not in PER_METRE:
        raise InputError("unknown unit", where="--unit", found=unit, expected=" | ".join(PER_METRE), hint=hint)
    metres = size / PER_METRE[unit]
    if not SMALLEST_BODY <= metres <= LARGEST_BODY:
        raise InputError(
            "the body has an unlikely size",
            where=path,
            found=f"extents of {text} {unit}: {_length(metres)} across",
            expected="between 1 mm and 20 m",
            hint=hint,
        )
    if not USUAL[0] <= metres <= USUAL[1]:
        warnings.warn(
            f"{path}: the body is {_length(metres)} across with --unit {unit}; {hint}, if that is what was meant", stacklevel=3
        )


def _length(metres: float) -> str:
    return f"{metres:.3g} m" if metres >= 1 else f"{1e3 * metres:.3g} mm"


# The report


def mesh_report(filled: Filled, options: MeshOptions) -> dict[str, Any]:
    """Return size, surface error, quality and notes as plain values."""
    quality = quality_report(filled.mesh)
    return {
        "edge_wanted_mm": filled.edge_mm,
        "tolerance_mm": filled.tolerance_mm,
        "deviation_mm": filled.deviation_mm,
        "done": list(filled.done),
        "quality": quality,
        "advice": _advice(quality, options),
    }


def _advice(quality: dict[str, Any], options: MeshOptions) -> list[str]:
    advice = []
    least = 1.0 if options.element == "tet10" else 2.0
    if quality["elements_through"]["fifth_percentile"] < least:
        advice.append(
            f"thin walls have less than {least:g} elements through them: the model is too stiff there; a smaller --size, "
            f"or more --max-tets"
        )
    if quality["radius_ratio"]["min"] < POOR:
        advice.append("the worst element is nearly flat: another --size or a larger --tolerance gives better ones")
    if options.element == "tet4":
        advice.append('tet4 bends much too stiffly at this size; element = "tet10" in robot.toml')
    return advice


def mesh_text(report: dict[str, Any]) -> str:
    """Return a report as a table."""
    lines = [
        quality_text(report["quality"]),
        f"  {'surface error':<19}at most {max(report['deviation_mm'], 1e-3):.3g} mm (allowed: {report['tolerance_mm']:.3g} mm)",
    ]
    for title, texts in (("notes", report["done"]), ("advice", report["advice"])):
        if texts:
            lines += ["", f"{title}:", *(f"  - {text}" for text in texts)]
    return "\n".join(lines)


# The folder


def _check_target(target: Path) -> None:
    if target.exists() and not target.is_dir():
        raise InputError("stands in the way", where=target, found="a file", expected="a folder", hint="another -o")
    if target.is_dir() and any(target.iterdir()) and not (target / "robot.toml").is_file():
        raise InputError(
            "the folder contains something else than a robot",
            where=target,
            expected="a new folder, or one with robot.toml",
            hint="another -o",
        )
    check_target(target, folder=True)


def report_in(target: Path) -> dict[str, Any]:
    """Return the report of a robot's folder; empty where there is none."""
    import json

    try:
        known = json.loads((target / REPORT_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return known if isinstance(known, dict) else {}


def finished(target: Path, inputs: dict[str, Any]) -> dict[str, Any] | None:
    """Return the report of a folder that holds the mesh of these inputs already; None where it has to be made."""
    import json

    known = report_in(target)
    try:
        same = known["inputs"] == json.loads(json.dumps(inputs)) and known["femsense"] == femsense.__version__
        whole = file_hash(target / known["robot"]["mesh_file"]) == known["mesh_sha256"] and (target / "robot.toml").is_file()
    except (OSError, KeyError, TypeError):
        return None
    return known if same and whole else None


def _write_robot(target: Path, mesh: TetMesh, options: MeshOptions, source: Path) -> dict[str, Any]:
    """Write mesh and robot.toml where they load together; return the report's part about them."""
    toml = target / "robot.toml"
    is_new = not toml.is_file()
    text = starter_text(mesh, options, target.absolute().name, source.name) if is_new else toml.read_text(encoding="utf-8-sig")
    text, name, unit = (text, MESH_FILE, options.unit or "m") if is_new else _with_mesh(text, toml)
    scaled = TetMesh(mesh.nodes * PER_METRE[unit], mesh.tets)
    with tempfile.TemporaryDirectory(prefix="femsense-") as trial:
        write_mesh(scaled, Path(trial) / name)
        (Path(trial) / "robot.toml").write_text(text, encoding="utf-8")
        _check_loads(Path(trial), toml)
        followed(target).mkdir(parents=True, exist_ok=True)
        write_mesh(scaled, target / name)
    if is_new or text != toml.read_text(encoding="utf-8-sig"):
        write_text(toml, text)
    return {"folder": str(target), "mesh_file": name, "unit": unit, "robot_toml": "written" if is_new else "kept"}


def _check_loads(trial: Path, toml: Path) -> None:
    try:
        load_robot(trial)
    except FemsenseError as error:
        text = str(error).replace(str(trial), str(toml.parent))
        raise InputError(
            "robot.toml does not fit the new mesh; nothing was written",
            where=toml,
            found=text,
            expected="a robot that loads",
            hint="mend robot.toml, or -o another folder",
        ) from None


def _with_mesh(text: str, toml: Path) -> tuple[str, str, str]:
    """Return robot.toml with a mesh file that can be written, that file's name and its unit."""
    try:
        table = tomllib.loads(text)["mesh"]
        file, unit = str(table["file"]), str(table["unit"])
    except (tomllib.TOMLDecodeError, KeyError, TypeError):
        raise InputError(
            "robot.toml has no table [mesh] with file and unit",
            where=toml,
            expected="a robot.toml, or a new folder",
            hint="femsense inspect says what is wrong with it",
        ) from None
    known = length_unit(unit, allowed=PER_METRE)
    if known is None:
        raise InputError("unknown unit", where=f"{toml}: mesh.unit", found=unit, expected=" | ".join(PER_METRE))
    unit = known.name
    if file.endswith(".vtu"):
        return text, file, unit
    named = re.compile(r"^(\s*file\s*=\s*)([\"'])" + re.escape(file) + r"\2", re.MULTILINE)
    if len(named.findall(text)) != 1:
        raise InputError(
            "the mesh file cannot be replaced",
            where=f"{toml}: mesh.file",
            found=file,
            expected=f'file = "{MESH_FILE}"',
            hint="write that line by hand and run it again",
        )
    return named.sub(rf'\1"{MESH_FILE}"', text), MESH_FILE, unit


def starter_text(mesh: TetMesh, options: MeshOptions, name: str, source: str) -> str:
    """Return a robot.toml for a mesh in metres that loads at once and marks the values to check."""
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    box = _lowest_slab(mesh)
    top = mesh.nodes[mesh.nodes[:, 2].argmax()]
    inner = mesh.nodes[mesh.tets[:, :4]].mean(axis=1)
    upper = inner[np.argmax(inner[:, 2] - 0.5 * np.linalg.norm(inner[:, :2] - inner[:, :2].mean(axis=0), axis=1))]
    values = {
        "name": re.sub(r"[^\w.-]", "-", name) or "robot",
        "source": source.replace("\n", " "),
        "file": MESH_FILE,
        "unit": options.unit or "m",
        "element": options.element,
        "low": _triple(low),
        "high": _triple(high),
        "box": f"[{_triple(box[0])}, {_triple(box[1])}]",
        "height": f"{1e3 * (high[2] - low[2]):.4g}",
        "path": _triple(upper),
        "pull": _triple([upper[0], upper[1], low[2] - 0.1 * (high[2] - low[2])]),
        "marker": _triple(top),
        "chambers": _chambers_text(mesh),
    }
    template = (Path(__file__).parent / "starter.toml").read_text(encoding="utf-8")
    return re.sub(r"<(\w+)>", lambda found: values[found[1]], template)


def _chambers_text(mesh: TetMesh) -> str:
    """Return tables for the cavities that were kept, to be filled in; empty where there are none."""
    seeds = cavity_seeds(mesh)
    if not seeds:
        return ""
    tables = [
        f'# [[chambers]]\n# name = "chamber-{i + 1}"\n# seed_m = {_triple(seed)}\n# max_pressure_pa = 40e3\n'
        for i, seed in enumerate(seeds)
    ]
    return "\n# YOURS: inner cavities. Uncommented, each table makes one a chamber under pressure.\n" + "".join(tables)


def _triple(point: FloatArray | list[float]) -> str:
    return "[" + ", ".join(f"{round(float(value), 6) + 0.0:g}" for value in point) + "]"


def _lowest_slab(mesh: TetMesh) -> FloatArray:
    """Return a box [m] around the lowest nodes, high enough to hold the body but a tenth of its height if that does."""
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    size = high - low
    for share in (0.02, 0.05, 0.1, 0.2, 0.4):
        top = low[2] + share * size[2]
        held = mesh.nodes[mesh.nodes[:, 2] <= top]
        spread = np.linalg.svd(held - held.mean(axis=0), compute_uv=False)
        if len(held) >= 6 and spread[1] > 0.05 * size.max():
            break
    margin = 0.02 * size
    return np.round([low - margin, [high[0] + margin[0], high[1] + margin[1], top]], 6)
