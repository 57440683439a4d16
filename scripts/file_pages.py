"""Write docs/formats/files.md from the tables that read the files: every file, key, column, unit and default of robot and recording.

    python scripts/file_pages.py [--check]

With --check nothing is written; exit status 1 says that the page is not up to date.
"""

from __future__ import annotations

import sys
import types
import typing
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from femsense.io.clouds.frame_clouds import BESIDE, FOLDERS
from femsense.io.recording_columns import COLUMNS, MEANS
from femsense.io.recording_toml import RecordingTable
from femsense.io.robot_tables import RobotTable

PAGE = Path(__file__).resolve().parents[1] / "docs" / "formats" / "files.md"
HEAD = """# Files: robot and recording

All lengths are in metres, unless a key `unit` declares another unit; names of keys and columns end with their unit. Camera frames are those of OpenCV:
x right, y down, z forward, right-handed. `T_a_b` takes points of frame b to frame a: 4 rows of 4 numbers. An unknown key or column is an error.
"""
ROBOT = """## A robot: a folder with `robot.toml` and a mesh

The mesh file is next to `robot.toml`. It contains tetrahedra, or a closed surface (STL, OBJ, PLY, OFF) that is filled on first use. Tetrahedra come as
VTU in one or more pieces, VTK, Gmsh 1 to 4.1, Abaqus with one part or instance, Medit, TetGen, Nastran, XDMF and MED (`pip install h5py`) and the other
formats of meshio.
A duplicate tetrahedron is used once.

A complete `robot.toml`, of a finger along the x axis with one cable:

```toml
format = "femsense-robot-1"
name = "finger"

[mesh]
file = "finger.vtu"                      # tetrahedra, next to this file
unit = "m"                               # unit of the coordinates in it
element = "tet10"                        # quadratic elements; "tet4": linear ones

[material]
young_modulus_pa = 1.2e6
poisson_ratio = 0.46
density_kg_m3 = 1070.0

[gravity]                                # without this table the body has no weight
vector_m_s2 = [0.0, 0.0, -9.81]

[[fixed]]                                # the clamp: nodes in this box do not move
box_m = [[-0.001, -0.011, -0.001], [0.001, 0.011, 0.021]]

[[cables]]
name = "flexor"                          # its column in frames.csv: cable_flexor
path_m = [[0.088, 0.0, 0.0111], [0.062, 0.0, 0.0124], [0.036, 0.0, 0.0137], [0.0105, 0.0, 0.0150]]   # from the tip to the motor
pull_point_m = [-0.01, 0.0, 0.0155]      # fixed in space; the cable runs from here to its motor
max_tension_n = 1.6

[[markers]]
name = "tip"
position_m = [0.092, 0.0, 0.007]         # at rest

[appearance]
color_rgb = [0.86, 0.52, 0.16]           # separates the robot from objects in clouds with colours
```

The tables below list every key. "None" as a default means that the key can be left out.
"""
NOTES = {
    "`[material]`": "Give a `name`, or the three values. A value takes precedence over that of the named material.",
    "`[[cables]]`": "`path_m` lists the points of the body to which the cable is tied or through which it runs, from its far end to the motor.",
    "`[[regions]]`": "Place a region with exactly one of `box_m`, `center_m` and `radius_m`, or `cells` and `value`.",
    "`[[tools]]`": "Give exactly one shape: `radius_m` (a ball), `cylinder`, or `mesh` and `unit`.",
}
"""What the table of a key does not show."""
RECORDING = """## A recording: a folder

```text
recording.toml  frames.csv  [markers.csv]  [rest.csv]  [loads.csv]  [clouds/000000.ply …]  [depth/000000.png …  color/000000.png …]
```

A minimal recording with markers: `recording.toml`

```toml
format = "femsense-recording-1"
actuation = "tension"                    # cable columns of frames.csv are tensions [N]
actuation_zero = "absolute"              # they are true values; "unknown": they count from an unknown initial value
```

`frames.csv`, with two contact-free frames at rest and pulled, and one in which something may touch

```text
frame,time_s,cable_flexor,free
0,0.0,0.0,1
1,1.0,0.8,1
2,2.0,0.8,0
```

and `markers.csv`

```text
frame,marker,x_m,y_m,z_m
0,tip,0.0412,0.0105,0.2631
1,tip,0.0396,-0.0021,0.2633
2,tip,0.0399,0.0004,0.2632
```
"""


def page() -> str:
    """Return the whole page."""
    parts = [HEAD, ROBOT, *_tables("robot.toml", RobotTable)]
    parts += ["`[[effects]]`: [Effects](../effects/README.md) lists names, parameters and units.\n"]
    parts += [RECORDING, *_tables("recording.toml", RecordingTable)]
    parts += [_csv(file) for file in COLUMNS]
    parts += [_folders()]
    return "\n".join(parts)


def _tables(file: str, schema: type[BaseModel]) -> list[str]:
    """Return a table of keys for a file and for each of the tables in it."""
    waiting, texts = [(f"`{file}`", schema)], []
    while waiting:
        title, table = waiting.pop(0)
        rows = [_row(name, field) for name, field in table.model_fields.items()]
        note = f"{NOTES[title]}\n\n" if title in NOTES else ""
        texts.append(f"### {title}\n\n{note}| key | type | default | meaning |\n|---|---|---|---|\n" + "".join(rows))
        for name, field in table.model_fields.items():
            inner, several = _inner(field.annotation)
            if inner is not None:
                place = title.strip("`[]").removeprefix(file).strip()
                key = ".".join(part for part in (place, name) if part)
                waiting.append((f"`[[{key}]]`" if several == "list" else f"`[{key}{'.NAME' if several else ''}]`", inner))
    return texts


def _row(name: str, field: FieldInfo) -> str:
    default = "required" if field.is_required() else _default(field)
    description = (field.description or "").replace("|", "\\|")
    return f"| `{name}` | {_kind(field.annotation)} | {default} | {description} |\n"


def _default(field: FieldInfo) -> str:
    value = field.get_default(call_default_factory=True, validated_data={})
    if value is None or isinstance(value, BaseModel):
        return "none"
    return f"`{str(value).replace(chr(39), chr(34))}`"


def _kind(annotation: Any) -> str:
    """Return the type of a value, as the page names it."""
    bare = _bare(annotation)
    origin = typing.get_origin(bare)
    if origin is typing.Literal:
        return " \\| ".join(f'`"{value}"`' for value in typing.get_args(bare))
    if origin is list:
        inner, several = _inner(bare)
        return "tables" if inner is not None and several else f"list of {_kind(typing.get_args(bare)[0])}"
    if origin is dict:
        return "tables" if _inner(bare)[0] is not None else "table"
    if isinstance(bare, type) and issubclass(bare, BaseModel):
        return "table"
    return {float: "number", int: "whole number", str: "text", bool: "true \\| false"}.get(bare, "value")


def _inner(annotation: Any) -> tuple[type[BaseModel] | None, str]:
    """Return the table that a key holds, and whether it holds a list or a dict of them."""
    bare = _bare(annotation)
    if isinstance(bare, type) and issubclass(bare, BaseModel):
        return bare, ""
    origin, arguments = typing.get_origin(bare), typing.get_args(bare)
    if origin in (list, dict) and arguments:
        last = _bare(arguments[-1])
        if isinstance(last, type) and issubclass(last, BaseModel):
            return last, origin.__name__
    return None, ""


def _bare(annotation: Any) -> Any:
    """Strip Optional and Annotated."""
    while True:
        origin = typing.get_origin(annotation)
        if origin is typing.Annotated:
            annotation = typing.get_args(annotation)[0]
        elif origin in (typing.Union, types.UnionType):
            annotation = next(a for a in typing.get_args(annotation) if a is not type(None))
        else:
            return annotation


def _csv(file: str) -> str:
    rows = "".join(f"| `{c.name}` | {'required' if c.required else 'optional'} | {c.holds} |\n" for c in COLUMNS[file])
    return f"### `{file}`\n\n{MEANS[file]}\n\n| column | | meaning |\n|---|---|---|\n{rows}"


def _folders() -> str:
    holds = {
        "clouds": (
            "the cloud of a frame, camera frame, metres, colours where the camera has them (0–1, 0–255 or 0–65535, under the "
            "usual names)"
        ),
        "depth": "a depth image of 16 bits, one unit is `depth_unit_m`; 0 where there is none",
        "color": "a colour image of 8 or 16 bits, registered to the depth image",
    }
    rows = "".join(f"| `{name}/` | {', '.join(endings)} | {holds[name]} |\n" for name, endings in FOLDERS.items())
    return (
        "### Clouds and images\n\nA file's name is the number of its frame. With several cameras each has folders of its "
        "own: `clouds/NAME/`, `depth/NAME/`,\n"
        f"`color/NAME/`. Notes ({', '.join(BESIDE)}) are allowed in these folders; a warning lists other files.\n\n| folder | "
        f"endings | content |\n|---|---|---|\n{rows}"
    )


def main(arguments: list[str]) -> int:
    """Write the page, or compare it."""
    text = page()
    if "--check" in arguments:
        return 0 if PAGE.is_file() and PAGE.read_text(encoding="utf-8") == text else 1
    PAGE.write_text(text, encoding="utf-8", newline="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
