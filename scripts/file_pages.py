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
from femsense.model.effects import EFFECT_NAMES

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
"""
RECORDING = """## A recording: a folder

```
recording.toml   frames.csv   [markers.csv]   [rest.csv]   [loads.csv]   [clouds/000000.ply …]   [depth/000000.png …   color/000000.png …]
```

"""


def page() -> str:
    """Return the whole page."""
    parts = [HEAD, ROBOT, *_tables("robot.toml", RobotTable)]
    parts += [f"Names of effects: {', '.join(f'`{name}`' for name in EFFECT_NAMES)}.\n"]
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
        texts.append(f"### {title}\n\n| key | value | default | |\n|---|---|---|---|\n" + "".join(rows))
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
        return "–"
    return f"`{str(value).replace(chr(39), chr(34))}`"


def _kind(annotation: Any) -> str:
    """Return the type of a value in words."""
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
    return f"### `{file}`\n\n{MEANS[file]}\n\n| column | | |\n|---|---|---|\n{rows}"


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
        f"endings | |\n|---|---|---|\n{rows}"
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
