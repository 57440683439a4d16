"""Reading of TOML and CSV; errors name file, place, found and expected value."""

from __future__ import annotations

import csv
import io
import re
import tomllib
import types
import typing
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, TypeAdapter, ValidationError

from femsense.core.arrays import BoolArray, FloatArray, IntArray
from femsense.core.errors import InputError
from femsense.core.pose import check_pose
from femsense.core.text import did_you_mean, key_path, plain_name, short
from femsense.core.units import PER_METRE, length_unit
from femsense.io.text_numbers import plain_number


def _usual_unit(value: object) -> object:
    """Return a unit of length as it is usually written (MM and Millimeters are mm); anything else as it is."""
    unit = length_unit(value, allowed=PER_METRE) if isinstance(value, str) else None
    return value if unit is None else unit.name


LengthUnit = Annotated[Literal["m", "cm", "mm"], BeforeValidator(_usual_unit)]
"""A unit of lengths in files, in any spelling."""


Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Color = Annotated[list[Share], Field(min_length=3, max_length=3)]
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Matrix = Annotated[list[Annotated[list[float], Field(min_length=4, max_length=4)]], Field(min_length=4, max_length=4)]


class Schema(BaseModel):
    """Base of the tables of a TOML file: unknown keys, wrong types and numbers that are not finite are refused."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


T = TypeVar("T")


def at_key(path: Path, *location: int | str) -> str:
    """Return the place of a key in a file, for messages."""
    return f"{path}: {key_path(location)}"


def doubles(values: Sequence[object], what: str, path: Path, kind: str, key: str) -> Iterator[InputError]:
    """Yield a problem for each value that repeats one of an earlier table; None is ignored.

    Arguments:
        values: of one key of each of the tables `kind` of the file at `path`.
        what: the name of the value in messages.
    """
    for i, value in enumerate(values):
        if value is not None and value in values[:i]:
            yield InputError(
                f"a {what} occurs twice",
                where=at_key(path, kind, i, key),
                found=repr(value),
                expected=f"each {what} once",
                hint=f"{kind}[{values.index(value)}] has it too",
            )


def pose_problems(pose: Any, where: str) -> Iterator[InputError]:
    """Yield the problem of a matrix that is no pose; none of None."""
    try:
        if pose is not None:
            check_pose(pose, where)
    except InputError as problem:
        yield problem


# TOML


def read_toml(path: Path) -> dict[str, Any]:
    """Return the document of a TOML file. Raises InputError with line and column."""
    text = read_text(path)
    try:
        document: dict[str, Any] = _composed("", tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        hint = "text needs quotes; a [table] goes on until the next one"
        if "\\" in str(error) or "escape" in str(error).lower() or "hex" in str(error).lower():
            hint = "a backslash begins an escape: write paths with / or in single quotes"
        if re.search("[“”„‘’]", text):
            hint = "typographic quotes are no quotes in TOML: write straight ones"
        raise InputError("not valid TOML", where=path, found=str(error), hint=hint) from None
    return document


FILE_KEYS = ("file", "mesh")
"""Keys whose texts are paths: names of files stay as they are written."""


def _composed(key: str, value: Any) -> Any:
    """Return a document with its texts in Unicode's composed form (NFC), but for paths."""
    if isinstance(value, dict):
        return {unicodedata.normalize("NFC", name): _composed(name, item) for name, item in value.items()}
    if isinstance(value, list):
        return [_composed(key, item) for item in value]
    return unicodedata.normalize("NFC", value) if isinstance(value, str) and key not in FILE_KEYS else value


def beside(path: Path, name: str) -> Path:
    """Return the file that a document at `path` names, relative to its folder; é in either spelling finds it.

    Raises:
        InputError: the name holds a tab or a line feed, or the backslashes of another system, and there is no such file.
    """
    file = path.parent / name
    if file.exists():
        return file
    odd = sorted(
        {
            {"\t": "\\t", "\n": "\\n", "\r": "\\r", "\f": "\\f", "\b": "\\b"}.get(c, "a control character")
            for c in name
            if ord(c) < 32
        }
    )
    if odd:
        raise InputError(
            "a path with control characters",
            where=path,
            found=repr(name),
            expected="the name of a file",
            hint=f"{' and '.join(odd)} in double quotes is no part of a path: write / for the backslash, or single quotes",
        )
    if "\\" in name:
        raise InputError(
            "a path with backslashes, which name no folders on this system",
            where=path,
            found=name,
            expected=name.replace("\\", "/"),
            hint="write / between folders: every system reads that",
        )
    same = plain_name(file.name)
    around = file.parent.iterdir() if file.parent.is_dir() else ()
    return next((other for other in around if plain_name(other.name) == same), file)


def read_text(path: Path) -> str:
    """Return a text file's content without a byte order mark. Raises InputError."""
    try:
        data = path.read_bytes()
        return data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except UnicodeDecodeError as error:
        if kind := _known_binary(path):
            raise InputError("not a text file", where=path, found=kind, expected="a text file in UTF-8") from None
        raise InputError(
            "not a UTF-8 text file", where=path, found=f"byte {error.start}", expected="UTF-8", hint="save it as UTF-8"
        ) from None
    except OSError as error:
        raise InputError("cannot be read", where=path, found=error.strerror) from None


def _known_binary(path: Path) -> str | None:
    """Return the kind of a binary file by its first bytes."""
    with path.open("rb") as stream:
        head = stream.read(16)
    starts = {
        b"glTF": "a glTF scene (.glb), which femsense writes and does not read",
        b"PK\x03\x04": "a ZIP archive",
        b"\x89PNG": "a PNG image",
        b"\xff\xd8\xff": "a JPEG image",
        b"#ROSBAG": "a bag of ROS: femsense import reads it",
        b"SQLite f": "a database, perhaps a bag of ROS 2: femsense import reads it",
        b"\x89MCAP": "an MCAP file: femsense import reads it",
        b"\x1f\x8b": "a gzip archive",
        b"%PDF": "a PDF document",
    }
    found = next((name for start, name in starts.items() if head.startswith(start)), None)
    return found or ("bytes that are no text" if b"\0" in head else None)


def validated(schema: type[T], document: Any, path: Path) -> T:
    """Return the checked document of a schema or dataclass. Raises the first InputError of `schema_problems`."""
    problems = schema_problems(schema, document, path)
    if problems:
        raise problems[0]
    return TypeAdapter(schema).validate_python(document)


def schema_problems(schema: type[Any], document: Any, path: Path) -> list[InputError]:
    """Return the problems of a document, unknown keys first (a misspelt key is also reported as a missing one)."""
    try:
        TypeAdapter(schema).validate_python(document)
    except ValidationError as error:
        found = sorted(error.errors(include_url=False), key=lambda item: item["type"] != "extra_forbidden")
        return [_problem(schema, item, path) for item in found]
    return []


def _problem(schema: type[Any], item: Any, path: Path) -> InputError:
    """Translate one finding of pydantic."""
    location = tuple(item["loc"])
    where = at_key(path, *location) if location else str(path)
    kind = item["type"]
    if kind == "extra_forbidden":
        known = list(_keys_at(schema, location[:-1]))
        return InputError(
            "unknown key",
            where=where,
            found=short(str(location[-1])),
            expected=" | ".join(known),
            hint=did_you_mean(str(location[-1]), known),
        )
    expected = _description_at(schema, location)
    if kind == "missing":
        return InputError("a required key is missing", where=where, found="nothing", expected=expected)
    if kind == "value_error":
        error = item["ctx"]["error"]
        found = short(item["input"]) if location else ", ".join(item["input"])  # of the whole document its keys are enough
        return InputError(str(error), where=where, found=found, expected=expected)
    what = str(item["msg"]).replace("Input should", "should").replace(", got inf or nan", "")
    what = what.replace("List should have", "should have").replace("String should", "should").replace(" after validation", "")
    return InputError(what, where=where, found=short(item["input"]), expected=expected)


def _keys_at(schema: type[Any], location: Sequence[int | str]) -> Iterable[str]:
    inner = _annotation_at(schema, location)
    return inner.model_fields if isinstance(inner, type) and issubclass(inner, BaseModel) else ()


def _description_at(schema: type[Any], location: Sequence[int | str]) -> str | None:
    """Return the schema's description of the innermost described key of a place."""
    description: str | None = None
    for i, part in enumerate(location):
        table = _annotation_at(schema, location[:i])
        field = table.model_fields.get(str(part)) if isinstance(table, type) and issubclass(table, BaseModel) else None
        description = field.description or description if field else description
    return description


def _annotation_at(schema: Any, location: Sequence[int | str]) -> Any:
    for part in location:
        if isinstance(schema, type) and issubclass(schema, BaseModel):
            field = schema.model_fields.get(str(part))
            schema = _bare(field.annotation) if field else None
        else:
            arguments = typing.get_args(schema)
            schema = _bare(arguments[-1]) if arguments else None
    return schema


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


# CSV


@dataclass(frozen=True, eq=False, slots=True)
class Table:
    """The cells of a CSV file, as text."""

    path: Path
    columns: tuple[str, ...]
    cells: tuple[tuple[str, ...], ...]
    """One tuple a row."""
    lines: tuple[int, ...]
    """Line of each row in the file, from 1."""

    def __len__(self) -> int:
        return len(self.cells)

    def place(self, row: int, column: str | None = None) -> str:
        """Return the position of a cell, for messages."""
        return f"{self.path}, line {self.lines[row]}" + (f", column {column}" if column else "")

    def without(self, rows: BoolArray) -> Table:
        """Return the table without the rows that a mask, shape (rows,), chooses."""
        kept = np.flatnonzero(~rows).tolist()
        return Table(self.path, self.columns, tuple(self.cells[i] for i in kept), tuple(self.lines[i] for i in kept))

    def text(self, column: str) -> tuple[str, ...]:
        """Return a column as text in its composed form, without blanks and other padding at the ends.

        Raises:
            InputError: control characters within a cell.
        """
        index = self.columns.index(column)
        cells = tuple(plain_name(row[index]) for row in self.cells)
        bad = next((i for i, cell in enumerate(cells) if not cell.isprintable()), None)
        if bad is not None:
            raise InputError(
                "control characters in a cell", where=self.place(bad, column), found=repr(cells[bad]), expected="plain text"
            )
        return cells

    def numbers(self, columns: Sequence[str], *, empty_is_nan: bool = False) -> FloatArray:
        """Return columns as finite numbers, shape (rows, columns); with `empty_is_nan` a cell may be empty or nan.

        Raises InputError with line and column.
        """
        result = np.empty((len(self.cells), len(columns)))
        for j, column in enumerate(columns):
            result[:, j] = self._column(column, empty_is_nan)
        return result

    def integers(self, column: str) -> IntArray:
        """Return a column of whole numbers ≥ 0, shape (rows,). Raises InputError with line and column."""
        values = self._column(column, False)
        bad = np.flatnonzero((values != np.rint(values)) | (values < 0))
        if len(bad):
            raise InputError(
                "not a whole number ≥ 0", where=self.place(bad[0], column), found=self.text(column)[bad[0]], expected="0, 1, 2, …"
            )
        return values.astype(np.int64)

    def _column(self, column: str, empty_is_nan: bool) -> FloatArray:
        cells = self.text(column)
        empty = ("", "nan") if empty_is_nan else ()
        numbers = [np.nan if cell.lower() in empty else plain_number(cell) for cell in cells]
        bad = next((row for row, number in enumerate(numbers) if number is None), None)
        if bad is not None:
            raise InputError(
                "not a number",
                where=self.place(bad, column),
                found=cells[bad] or "an empty cell",
                expected="a number",
                hint="decimal points, not commas" if "," in cells[bad] else None,
            )
        values = np.array(numbers, dtype=np.float64)
        odd = next((row for row in np.flatnonzero(~np.isfinite(values)).tolist() if cells[row].lower() not in empty), None)
        if odd is not None:
            raise InputError(
                "not a finite number",
                where=self.place(odd, column),
                found=cells[odd],
                expected="a finite number",
                hint="leave the row out where nothing was measured",
            )
        return values


def read_csv(path: Path, *, required: Sequence[str], optional: Sequence[str] = (), prefixes: Sequence[str] = ()) -> Table:
    """Return the cells of a CSV file with a header.

    A byte order mark, CRLF, blanks around names and empty lines are accepted.

    Arguments:
        path: the file.
        required, optional: names of columns.
        prefixes: columns that start so (and have more than that) are accepted too.

    Raises:
        InputError: a missing, unknown or double column, or a row of another length.
    """
    reader = csv.reader(io.StringIO(read_text(path), newline=""))
    rows = [(reader.line_num, tuple(row)) for row in reader if any(cell.strip() for cell in row)]
    if not rows:
        raise InputError("the file is empty", where=path, expected=f"a header: {','.join(required)}")
    columns = tuple(plain_name(cell) for cell in rows[0][1])
    _check_header(path, columns, required, optional, prefixes)
    for line, row in rows[1:]:
        if len(row) != len(columns):
            raise InputError(
                "a row of another length than the header",
                where=f"{path}, line {line}",
                found=f"{len(row)} cells",
                expected=f"{len(columns)} cells: {','.join(columns)}",
                hint="decimal points, not commas",
            )
    return Table(path, columns, tuple(row for _, row in rows[1:]), tuple(line for line, _ in rows[1:]))


def _check_header(
    path: Path, columns: Sequence[str], required: Sequence[str], optional: Sequence[str], prefixes: Sequence[str]
) -> None:
    where = f"{path}, header"
    if len(columns) == 1 and any(separator in columns[0] for separator in (";", "\t")):
        raise InputError(
            "separated by semicolons or tabs",
            where=where,
            found=short(columns[0]),
            expected="commas between the cells, points in the numbers",
            hint="export it again as comma-separated values",
        )
    known = [*required, *optional]
    for i, column in enumerate(columns):
        prefixed = any(column.startswith(prefix) and len(column) > len(prefix) for prefix in prefixes)
        if column not in known and not prefixed:
            names = [*known, *(f"{prefix}NAME" for prefix in prefixes)]
            raise InputError(
                "unknown column", where=where, found=short(column), expected=", ".join(names), hint=did_you_mean(column, known)
            )
        if column in columns[:i]:
            raise InputError("a column occurs twice", where=where, found=column, expected="each column once")
    missing = [column for column in required if column not in columns]
    if missing:
        raise InputError("columns are missing", where=where, found=", ".join(columns), expected=", ".join(missing))
