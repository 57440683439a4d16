"""Intrinsics from text, JSON and YAML files: identified by names, else by the shape of matrices, else by the order of numbers.

Digits within words and in comments are ignored. `check_lens` refuses implausible intrinsics.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.io.importers.frames import camera_of_numbers
from femsense.io.importers.ros.messages import MODELS
from femsense.io.tables import read_text
from femsense.io.text_numbers import notation_of
from femsense.model.camera import Camera
from femsense.model.plausibility import lens_problem

JSON_NAMES = ("camera_intrinsic.json", "intrinsic.json", "intrinsics.json", "camera.json", "camera_info.json", "calibration.json")
TEXT_NAMES = (
    "calibration.txt",
    "camera.txt",
    "intrinsics.txt",
    "intrinsic.txt",
    "intrinsic_depth.txt",
    "camera-intrinsics.txt",
    "cam_K.txt",
    "K.txt",
    "calib.txt",
    "cameras.txt",
    "calibration.yaml",
    "camera.yaml",
    "camera_info.yaml",
    "intrinsics.yaml",
    "calibration.yml",
    "camera.yml",
    "calibration.csv",
    "intrinsics.csv",
    "camera.csv",
    "calibration.xml",
    "camera.xml",
    "intrinsics.xml",
)
FILES = JSON_NAMES + TEXT_NAMES
"""Files of a lens in a folder of images; the first that is there is read."""
NAMES = {
    "fx": ("fx", "focal_x", "focal_length_x", "focalx", "f_x", "alpha_x", "au", "fu"),
    "fy": ("fy", "focal_y", "focal_length_y", "focaly", "f_y", "alpha_y", "av", "fv"),
    "f": ("f", "focal", "focal_length", "focallength"),
    "cx": ("cx", "ppx", "u0", "c_x", "principal_x", "principal_point_x", "center_x", "centre_x", "x0", "cu"),
    "cy": ("cy", "ppy", "v0", "c_y", "principal_y", "principal_point_y", "center_y", "centre_y", "y0", "cv"),
    "width": ("width", "w", "image_width", "imagewidth", "img_width", "cols_px", "columns"),
    "height": ("height", "h", "image_height", "imageheight", "img_height", "rows_px"),
    "k1": ("k1", "radial_1"),
    "k2": ("k2", "radial_2"),
    "p1": ("p1", "t1", "tangential_1"),
    "p2": ("p2", "t2", "tangential_2"),
    "k3": ("k3", "radial_3"),
    "k4": ("k4",),
    "k5": ("k5",),
    "k6": ("k6",),
    "skew": ("skew",),
}
"""Names of the numbers of a lens, in small letters."""
PAIRS = {
    "focal_length": ("fx", "fy"),
    "focallength": ("fx", "fy"),
    "focal": ("fx", "fy"),
    "principal_point": ("cx", "cy"),
    "principalpoint": ("cx", "cy"),
    "center": ("cx", "cy"),
    "radial_distortion": ("k1", "k2", "k3"),
    "radialdistortion": ("k1", "k2", "k3"),
    "tangential_distortion": ("p1", "p2"),
    "tangentialdistortion": ("p1", "p2"),
}
"""Names of two or three numbers."""
BY_BEND = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Coefficients of distortion in OpenCV's order."""
BENDS = re.compile(r"dist(?!ance)|radial|tangential|coeff", re.IGNORECASE)
"""Names of numbers that bend rays."""
BY_MODEL = {"pinhole": 4, "simple_pinhole": 3, "opencv": 8, "radtan": 8}
"""Models of COLMAP and DSO whose numbers are read in their order, and how many they have."""
MATRICES = ("k", "cam_k", "intrinsic_matrix", "camera_matrix", "intrinsics", "intrinsic", "m1", "k_depth")
PROJECTIONS = ("p", "projection_matrix", "p1_rect")
DISTORTIONS = ("d", "coeffs", "distortion_coeffs", "distortion", "distortion_coefficients", "dist_coeffs", "distcoeffs", "dist")
SIZES = ("resolution", "image_size", "size", "imagesize")
KNOWN = {name: key for key, names in NAMES.items() for name in names}
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.])")
WORD = re.compile(r"[A-Za-z_][\w./-]*")
MODEL = re.compile(r"(?i)\b((?:distortion_|camera[_.])?(?:model|type))[\"']?\s*[:=]\s*[\"']?([A-Za-z][\w ]*)")
COMMENT = re.compile(r"(?:#|//|%|^\s*;).*$|!!\S+|\bdt:\s*\w+")
XML_HEAD = re.compile(r"<\?.*?\?>|<!--.*?-->", re.DOTALL)
TAG = re.compile(r"<(/?)([\w.-]+)[^>]*>")
AGAIN = " again"
"""Behind a name that stood before."""
SHARE = 4.0
"""A focal length below this is a share of the image's size: of lenses with less than 14° no depth camera is known [1]."""
SKEW = 0.5
"""Largest shift by skew that is left out [px]: the resolution of an image."""
CENTRED, SQUARE = 0.2, 0.15
"""The usual lens has its principal point this near to the middle (share of the size), and pixels this square."""


@dataclass(frozen=True, eq=False, slots=True)
class _Found:
    """Numbers of a lens that were found in a file."""

    numbers: Mapping[str, float]
    """Of fx, fy, cx, cy, width, height, k1 …"""
    distortion: Sequence[float] = ()
    notes: tuple[str, ...] = field(default=())


def read_lens(path: Path, width: int, height: int) -> tuple[Camera, list[str]]:
    """Return the intrinsics in a file for images of a size [px], and the assumptions made.

    Raises:
        InputError: no intrinsics, those of another image size, or implausible ones (see `check_lens`).
    """
    text = read_text(path)
    found = _in_json(text, path) if path.suffix == ".json" else _in_text(text, width, height)
    if found is None:
        raise InputError(
            "no lens in this file",
            where=path,
            found=" ".join(text.split())[:80],
            expected="fx, fy, cx, cy by name, a matrix of 3 × 3, 3 × 4 or 4 × 4, or the four numbers in this order",
        )
    numbers = dict(found.numbers)
    said = int(numbers.get("width", width)), int(numbers.get("height", height))
    if said != (width, height):
        raise InputError(
            "the lens is of another size than the images",
            where=path,
            found=f"{said[0]} × {said[1]}",
            expected=f"{width} × {height}",
            hint="the size is width, height: are these rows, columns?"
            if said == (height, width)
            else "scale fx, fy, cx, cy by the ratio of the sizes",
        )
    numbers, notes = _in_pixels(numbers, width, height)
    notes += _check_skew(numbers, height, path)
    named = [numbers.get(key, 0.0) for key in BY_BEND] if any(key in numbers for key in BY_BEND) else []
    distortion = found.distortion or named
    name = _model_name(text) if any(distortion) else ""
    if name not in MODELS:
        known = ", ".join(sorted(set(MODELS) - {""}))
        raise InputError("an unknown distortion model", where=path, found=name, expected=known)
    focal, middle = (numbers["fx"], numbers["fy"]), (numbers["cx"], numbers["cy"])
    return check_lens(camera_of_numbers(width, height, focal, middle, distortion, MODELS[name]), path), [*found.notes, *notes]


def _check_skew(numbers: Mapping[str, float], height: int, path: Path) -> list[str]:
    """Return that a small skew is left out. Raises InputError for one that shifts a pixel at the edge of the images by more than SKEW."""
    skew = numbers.get("skew", 0.0)
    shift = abs(skew) * 0.5 * height / numbers["fy"] if numbers["fy"] else 0.0
    if shift > SKEW:
        raise InputError(
            "a lens with skew",
            where=path,
            found=f"{skew:g} beside fx, which shifts pixels by up to {shift:.3g}",
            expected="0: pixels are rectangles",
            hint="is the matrix in another order? Else rectify the images",
        )
    return [f"a skew of {skew:g} is left out: it shifts no pixel by more than {shift:.2g}"] if skew else []


def _model_name(text: str) -> str:
    """Return the name of the distortion model in a text, in small letters; "" where it names none, or that of Brown and Conrady."""
    named = max(MODEL.finditer(text), key=lambda match: "distortion" in match[1].lower(), default=None)
    name = "" if named is None else named[2].strip().lower()
    return "" if name in ("radtan", "pinhole", "perspective", "opencv") else name


def check_lens(lens: Camera, where: str | Path | None) -> Camera:
    """Return a lens that a camera can have. Raises InputError."""
    problem = lens_problem(lens.width, lens.height, (lens.fx, lens.fy, lens.cx, lens.cy), lens.distortion, lens.distortion_model)
    if problem:
        raise InputError(
            "numbers that are no lens of these images",
            where=where,
            found=f"{lens_text(lens)}; images of {lens.width} × {lens.height}",
            expected="focal lengths > 0 and a principal point in the image [px]; distortion k1 k2 p1 p2 k3 below 10",
            hint=problem,
        )
    return lens


def lens_text(lens: Camera) -> str:
    """Return the numbers of a lens as text."""
    bent = f", distortion {', '.join(f'{v:.4g}' for v in lens.distortion)}" if np.any(lens.distortion != 0.0) else ""
    return f"fx {lens.fx:.6g}, fy {lens.fy:.6g}, cx {lens.cx:.6g}, cy {lens.cy:.6g}{bent}"


def lens_line(lens: Camera) -> str:
    """Return image size, model and parameters of the intrinsics as text, for the summary of the import."""
    return f"{lens.width} × {lens.height}, {lens.distortion_model}, {lens_text(lens)}"


def _in_pixels(numbers: dict[str, float], width: int, height: int) -> tuple[dict[str, float], list[str]]:
    """Return focal lengths and principal point in pixels where they are shares of the image's size (as LSD-SLAM has them)."""
    keys, sizes = ("fx", "fy", "cx", "cy"), (width, height, width, height)
    values = [numbers[key] for key in keys]
    if not all(0.0 < v < SHARE for v in values) or max(values[2:]) >= 1.0:
        return numbers, []
    return numbers | {k: v * n for k, v, n in zip(keys, values, sizes)}, [
        "its numbers are shares of the images' width and height"
    ]


# JSON


def _in_json(text: str, path: Path) -> _Found | None:
    try:
        data = json.loads(text)
    except ValueError as error:
        raise InputError(
            "not a lens", where=path, found=str(error), expected="JSON with width, height, intrinsic_matrix"
        ) from None
    depth = (
        [value for key, value in data.items() if "depth" in key.lower() and isinstance(value, Mapping)]
        if isinstance(data, dict)
        else []
    )
    for part in [*depth, data]:  # of a colour and a depth camera the depth camera's
        flat: dict[str, list[float]] = {}
        _flatten("", part, flat)
        found = _of_names(flat)
        if found is not None:
            return found
    return None


def _flatten(name: str, value: Any, into: dict[str, list[float]]) -> None:
    """Collect numbers and lists of numbers under the last part of their key, in lower case; the first of several is kept."""
    if isinstance(value, Mapping):
        if set(map(str, value)) >= {"rows", "cols", "data"}:
            _flatten(name, value["data"], into)
            return
        for key, item in value.items():
            _flatten(str(key).lower(), item, into)
        return
    try:
        numbers = np.asarray(value, dtype=np.float64).ravel().tolist()
    except (TypeError, ValueError):
        for item in value if isinstance(value, list) else ():
            _flatten(name, item, into)
        return
    if numbers and not isinstance(value, bool | str):
        into.setdefault(name, numbers)


# Names


def _of_names(flat: Mapping[str, list[float]]) -> _Found | None:
    """Return the intrinsics identified by names, of a matrix or of fx, cx and similar; None without such names."""
    single = {KNOWN[name]: values[0] for name, values in flat.items() if name in KNOWN and len(values) == 1}
    sizes = next((flat[name] for name in SIZES if len(flat.get(name, ())) == 2), None)
    beside = dict(zip(("width", "height"), sizes)) if sizes else {}
    beside |= {key: single[key] for key in ("width", "height") if key in single}
    distortion = next((flat[name] for name in DISTORTIONS if len(flat.get(name, ())) >= 4), [])
    for name, keys in PAIRS.items():
        single |= dict(zip(keys, flat[name])) if 2 <= len(flat.get(name, ())) <= len(keys) else {}
    if "f" in single:
        single = {"fx": single["f"], "fy": single["f"]} | single
    beside |= {key: value for key, value in single.items() if key in BY_BEND}
    unread = [name for name, values in flat.items() if BENDS.search(name) and any(values)]
    known = distortion or any(key in single for key in BY_BEND)
    notes = (f"{', '.join(unread)}: not read, and the lens has no distortion without",) if unread and not known else ()
    if {"fx", "cx", "cy"} <= set(single):
        return _Found({"fy": single["fx"]} | single | beside, distortion, notes)
    for name in (*MATRICES, *PROJECTIONS):
        numbers = _matrix(np.array(flat.get(name, ())))
        if numbers is None and len(flat.get(name, ())) in (4, 5, 8, 9):  # as Kalibr and OpenVINS write them
            numbers = dict(zip(("fx", "fy", "cx", "cy"), flat[name]))
        if numbers is not None:
            return _Found(numbers | beside, () if name in PROJECTIONS else distortion, () if name in PROJECTIONS else notes)
    matrices = [numbers for values in flat.values() if (numbers := _matrix(np.array(values))) is not None]
    same = matrices and all(one == matrices[0] for one in matrices)
    return _Found(matrices[0] | beside, distortion, notes) if same else None


def _matrix(values: FloatArray) -> dict[str, float] | None:
    """Return fx, fy, cx, cy of a matrix of 3 × 3, 3 × 4 or 4 × 4 by rows or by columns; None for other matrices, such as poses."""
    shapes = {9: (3, 3), 12: (3, 4), 16: (4, 4)}
    if values.size not in shapes:
        return None
    given = values.reshape(shapes[values.size])
    turned = values.reshape(4, 3).T if values.size == 12 else given.T
    for K in (given, turned):
        below = K[1, 0] == K[2, 0] == K[2, 1] == 0.0
        rotation = max(abs(K[0, 0]), abs(K[1, 1])) <= 1.0 and not (0.2 < K[0, 2] < 0.8 and 0.2 < K[1, 2] < 0.8)
        if below and K[2, 2] == 1.0 and K[0, 0] != 0.0 and K[1, 1] != 0.0 and not rotation:
            skew = {"skew": float(K[0, 1])} if K[0, 1] != 0.0 else {}
            return {"fx": float(K[0, 0]), "fy": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])} | skew
    return None


# Text


def _in_text(text: str, width: int, height: int) -> _Found | None:
    plain = (
        TAG.sub(lambda tag: "\n" if tag[1] else f"\n{tag[2]}: ", XML_HEAD.sub("", text))
        if text.lstrip().startswith("<")
        else text
    )
    lines = [COMMENT.sub("", line).strip() for line in plain.splitlines()]
    lines = [line for line in lines if line]
    if notation_of(word for line in lines for word in line.split()).decimal == ",":
        lines = [re.sub(r"(?<=\d),(?=\d)", ".", line) for line in lines]
    named = _named_numbers(lines)
    found = _of_names(named) or _of_model(named, width, height) or _of_shape(lines) or _of_order(lines, width, height)
    if found is not None and any(name.removesuffix(AGAIN) in (*KNOWN, *MATRICES) for name in named if name.endswith(AGAIN)):
        found = replace(found, notes=(*found.notes, "the file has several lenses; the first is used"))
    if found is not None or "fx" in named:
        return found
    bare = [" ".join(NUMBER.findall(line)) for line in lines]  # numbers among words that name nothing
    return _of_order([line for line in bare if len(line.split()) >= 4], width, height)


def _of_model(named: Mapping[str, list[float]], width: int, height: int) -> _Found | None:
    """Return the numbers behind the name of a model, without the images' size before them (COLMAP's cameras.txt, DSO's camera.txt)."""
    name = next((name for name in BY_MODEL if name in named), None)
    if name is None:
        return None
    values, size = named[name], [float(width), float(height)]
    start = 2 if values[:2] == size else 0
    return _ordered(values[start : start + BY_MODEL[name]], width, height)


def _named_numbers(lines: Sequence[str]) -> dict[str, list[float]]:
    """Return name → the numbers behind it, to the next name; of a line of names only, those of the line below in its order."""
    flat: dict[str, list[float]] = {}
    rest = list(lines)
    for line, below in pairwise(lines):
        names, values = WORD.findall(line), NUMBER.findall(below)
        if names and not NUMBER.search(line) and len(names) == len(values) and not WORD.search(NUMBER.sub("", below)):
            flat |= {_last(name): [float(value)] for name, value in zip(names, values)}
            rest = [other for other in rest if other not in (line, below)]
    name = owner = ""  # of a matrix as OpenCV and ROS write it, which has rows, cols and data below its name
    for token in re.finditer(rf"{NUMBER.pattern}|{WORD.pattern}", "\n".join(rest)):
        if NUMBER.fullmatch(token[0]):
            if name:
                flat.setdefault(name, []).append(float(token[0]))
            continue
        word = _last(token[0])
        owner = owner if word in ("rows", "cols", "data") else word if word not in flat else f"{word}{AGAIN}"
        name = "" if word in ("rows", "cols") else owner
    return flat


def _last(name: str) -> str:
    """Return the last part of a name such as Camera.fx or depth/K, in small letters."""
    return re.split(r"[./]", name.rstrip("./-"))[-1].lower()


def _rows(lines: Sequence[str]) -> Iterator[list[float]]:
    """Yield the numbers of each line that holds nothing but numbers, brackets and marks between; a line of words as none."""
    for line in lines:
        yield [] if WORD.search(NUMBER.sub(" ", line)) else [float(value) for value in NUMBER.findall(line)]


def _of_shape(lines: Sequence[str]) -> _Found | None:
    """Return the first matrix written in one line, or in three or four lines of three or four numbers."""
    rows = list(_rows(lines))
    for i, count in product(range(len(rows)), (1, 3, 4)):
        block = rows[i : i + count]
        if len(block) == count and len({len(row) for row in block}) == 1 and (count == 1 or len(block[0]) in (3, 4)):
            numbers = _matrix(np.array(block).ravel())
            if numbers is not None:
                return _Found(numbers, next((row for row in rows[i + count :] if len(row) in (5, 8)), ()))
    return None


def _of_order(lines: Sequence[str], width: int, height: int) -> _Found | None:
    """Return the numbers of a file without names: the images' size is taken out, then fx fy cx cy (or f cx cy) and distortion follow.

    Another order is taken where this one gives no usual lens and only the other does. Of two blocks that begin with a size the last is
    the depth camera's (InfiniTAM).
    """
    rows = list(_rows(lines))
    rows = rows[: next((i for i, row in enumerate(rows) if not row and i), len(rows))]
    sizes = [i for i, row in enumerate(rows) if row == [float(width), float(height)]]
    notes: tuple[str, ...] = ()
    if sizes and sizes[0] == 0:
        notes = ("of several blocks with a size the last is read, which is the depth camera's",) if len(sizes) > 1 else ()
        rows = [row for row in rows[sizes[-1] + 1 :] if len(sizes) == 1 or len(row) == 2]
    found = _ordered([value for row in rows for value in row], width, height)
    return None if found is None else replace(found, notes=(*notes, *found.notes))


def _ordered(values: list[float], width: int, height: int) -> _Found | None:
    for size in ([float(width), float(height)], [float(height), float(width)]):
        values = values[2:] if values[:2] == size else values[:-2] if values[-2:] == size else values
    values = [values[0], *values] if len(values) == 3 else values
    shares = len(values) == 5 and max(map(abs, values[:4])) < SHARE
    if len(values) == 5 and values[4] == 0.0:
        values = values[:4]
    if len(values) not in (4, 5, 6, 8, 9, 12) or (shares and len(values) == 5):
        return None  # the fifth number of LSD-SLAM is a distortion model of its own
    orders = {"fx fy cx cy": (0, 1, 2, 3), "fx cx fy cy": (0, 2, 1, 3), "cx cy fx fy": (2, 3, 0, 1)}
    usual = [name for name, order in orders.items() if _is_usual([values[i] for i in order], width, height)]
    name = usual[0] if len(usual) == 1 else "fx fy cx cy"
    numbers = dict(zip(("fx", "fy", "cx", "cy"), [values[i] for i in orders[name]]))
    notes = () if name == "fx fy cx cy" else (f"its numbers are read as {name}: only so the principal point is near the middle",)
    return _Found(numbers, [*values[4:], *[0.0] * 5][: max(5, len(values) - 4)] if len(values) > 4 else (), notes)


def _is_usual(values: Sequence[float], width: int, height: int) -> bool:
    fx, fy, cx, cy = values
    if max(map(abs, values)) < SHARE:
        fx, fy, cx, cy = fx * width, fy * height, cx * width, cy * height
    centred = abs(cx / width - 0.5) < CENTRED and abs(cy / height - 0.5) < CENTRED
    return centred and fx > 0 and fy > 0 and abs(fx / fy - 1.0) < SQUARE
