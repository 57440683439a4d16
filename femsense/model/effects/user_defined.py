"""Effects that a user writes: a Python file with a name, a table of parameters and one function (docs/effects/own.md)."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import FemsenseError, InputError
from femsense.model.effects.base import Effect, Entry, Parameter, build_entry
from femsense.model.robot import Robot

FUNCTIONS = {
    "forces": "forces(nodes_m, …) → nodal forces [N], (n, 3), for the nodes at rest [m], (n, 3)",
    "change": "change(robot, …) → another Robot",
    "correct": "correct(points_m, …) → true points [m], (k, 3), for measured ones [m], (k, 3), camera frame",
}
SPEC = {"unit": "1", "null": 0.0, "low": None, "high": None, "step": None, "scale": "linear", "size": None}
EXAMPLE = 'parameters = {"force_n": {"unit": "N", "low": -1.0, "high": 1.0}}'


def load_own_effect(path: str | Path) -> Effect:
    """Return the effect that a Python file describes. The file is run: take it from people whom you trust only.

    Raises:
        InputError: where the file is not there, does not run, or lacks something.
    """
    file = Path(path).expanduser().absolute()
    module = _run(file)
    name = getattr(module, "name", None)
    if not isinstance(name, str) or not name.isidentifier():
        raise InputError(
            "the effect has no name", where=f"{file}: name", found=name, expected='name = "magnet", letters, digits and _'
        )
    names = [key for key in FUNCTIONS if callable(getattr(module, key, None))]
    if not names:
        raise InputError(
            "the effect does nothing", where=file, found="none of its functions", expected=" | ".join(FUNCTIONS.values())
        )
    from femsense.model.effects import EFFECTS

    if name in {effect.name for effect in EFFECTS}:
        raise InputError("the name is taken", where=f"{file}: name", found=name, expected="a name of its own")
    parameters = _parameters(getattr(module, "parameters", None), file)
    seeds = _seeds(getattr(module, "seeds", ({},)), file)
    keys = tuple(dict.fromkeys([p.key for p in parameters] + [key for seed in seeds for key in seed]))

    def apply(robot: Robot, entry: Entry) -> Robot:
        values = {key: _value(entry[key]) for key in keys if key in entry}
        missing = [p.key for p in parameters if p.key not in values]
        if missing:
            raise InputError("a parameter is missing", where=f"{name}.{missing[0]}", expected=", ".join(keys))
        for function in names:
            robot = ACTIONS[function](robot, getattr(module, function), values, file)
        return robot

    return Effect(
        name,
        str(getattr(module, "lacks", (module.__doc__ or name).strip().splitlines()[0])),
        lambda robot, control: parameters,
        apply,
        lambda robot: tuple({"file": str(file), **seed} for seed in seeds),
        keys=("file", *keys),
    )


def try_own_effect(effect: Effect, robot: Robot) -> None:
    """Run a user-defined effect once at its null and once next to it, from each seed.

    Raises:
        InputError: a function fails or returns a wrong type, or the effect does not vanish at its null.
    """
    parameters = effect.parameters(robot, "")
    for seed in effect.seeds(robot):
        effect.apply(robot, build_entry(parameters, [p.null + p.step for p in parameters], seed))
        null = build_entry(parameters, [p.null for p in parameters], seed)
        if not _is_same(effect.apply(robot, null), robot):
            raise InputError(
                "the effect does not vanish at its null",
                where=seed["file"],
                expected="no forces, the same robot, the same points",
                found=", ".join(f"{p.key} = {null[p.key]}" for p in parameters if p.part in (None, 0))
                + ", which changes the robot",
                hint='declare the value without effect: "null" (femsense docs own)',
            )


def _is_same(robot: Robot, other: Robot) -> bool:
    """Return whether two robots have equal loads, stiffness and markers, by comparison of their arrays."""
    points = np.array([[0.0, 0.0, 0.5], [0.1, -0.1, 1.0]])
    for correct in robot.observation.corrections[len(other.observation.corrections) :]:
        if not np.allclose(correct(points), points, rtol=0.0, atol=1e-9):
            return False
    a, b = robot.body, other.body
    if a.mesh is not b.mesh:
        return True  # a change of the mesh is tried as a whole
    pairs = [(a.dead_forces, b.dead_forces), (a.gravity, b.gravity), *zip(a.material.lame(), b.material.lame())]
    return all(np.allclose(x, y, rtol=1e-9, atol=1e-12) for x, y in pairs)


def find_own_file(entry: Mapping[str, Any], robot: Robot) -> Path:
    """Return the file of an entry of `[[effects]]`: as given, or relative to robot.toml."""
    file = Path(str(entry["file"])).expanduser()
    return file if file.is_absolute() or robot.folder is None else robot.folder / file


def _run(file: Path) -> ModuleType:
    if not file.is_file():
        raise InputError("no such file", where=file, expected="a Python file with an effect", hint="see femsense docs own")
    spec = importlib.util.spec_from_file_location(f"femsense_own_{file.stem}", file)
    if spec is None or spec.loader is None:
        raise InputError("not a Python file", where=file, expected="a name that ends in .py")
    module, quiet = importlib.util.module_from_spec(spec), sys.dont_write_bytecode
    sys.dont_write_bytecode = True
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise InputError("the file does not run", where=_line(error, file), found=f"{type(error).__name__}: {error}") from None
    finally:
        sys.dont_write_bytecode = quiet
    return module


def _line(error: BaseException, file: Path) -> str:
    """Return the file with the last of its lines that the error came through."""
    line = getattr(error, "lineno", None)
    trace = error.__traceback__
    while trace is not None:
        line = trace.tb_lineno if trace.tb_frame.f_code.co_filename == str(file) else line
        trace = trace.tb_next
    return str(file) if line is None else f"{file}:{line}"


def _parameters(table: Any, file: Path) -> tuple[Parameter, ...]:
    where = f"{file}: parameters"
    if not isinstance(table, Mapping) or not table:
        raise InputError("the effect has no parameters", where=where, found=table, expected=EXAMPLE)
    result: list[Parameter] = []
    for key, spec in table.items():
        if not isinstance(spec, Mapping) or not {"low", "high"} <= set(spec):
            raise InputError("a parameter without bounds", where=f"{where}[{key!r}]", found=spec, expected=EXAMPLE)
        unknown = sorted(set(spec) - set(SPEC))
        if unknown:
            raise InputError("unknown key", where=f"{where}[{key!r}]", found=unknown[0], expected=", ".join(SPEC))
        result += _components(str(key), {**SPEC, **spec}, f"{where}[{key!r}]")
    return tuple(result)


def _components(key: str, spec: Mapping[str, Any], where: str) -> list[Parameter]:
    if spec["scale"] not in ("linear", "log", "reciprocal"):
        raise InputError("unknown scale", where=where, found=spec["scale"], expected="linear | log | reciprocal")
    try:
        null, low, high = (float(spec[k]) for k in ("null", "low", "high"))
        step = 1e-4 * (high - low) if spec["step"] is None else float(spec["step"])
        size = None if spec["size"] is None else int(spec["size"])
    except (TypeError, ValueError):
        raise InputError(
            "not a number", where=where, found=dict(spec), expected="numbers for null, low, high, step, size"
        ) from None
    if not low <= null <= high or low == high or step <= 0:
        raise InputError(
            "bounds that do not hold the null",
            where=where,
            found=f"low {low:g}, null {null:g}, high {high:g}",
            expected="low ≤ null ≤ high",
            hint="null is where the effect vanishes, 0 if not given",
        )
    parts: Sequence[int | None] = (None,) if size is None else range(size)
    return [Parameter(key, part, str(spec["unit"]), null, low, high, step, spec["scale"]) for part in parts]


def _seeds(seeds: Any, file: Path) -> tuple[Entry, ...]:
    if not isinstance(seeds, Sequence) or not len(seeds) or not all(isinstance(seed, Mapping) for seed in seeds):
        raise InputError(
            "not a list of tables",
            where=f"{file}: seeds",
            found=seeds,
            expected="seeds = [{…}, {…}]: values that are tried, not fitted",
        )
    return tuple(dict(seed) for seed in seeds)


def _value(value: Any) -> Any:
    return np.array(value, dtype=float) if isinstance(value, list) else value


def _call(function: Callable[..., Any], first: Any, values: Mapping[str, Any], file: Path) -> Any:
    try:
        return function(first, **values)
    except FemsenseError:
        raise
    except Exception as error:
        raise InputError(
            f"{function.__name__} fails",
            where=_line(error, file),
            found=f"{type(error).__name__}: {error}",
            expected=FUNCTIONS[function.__name__],
        ) from None


def _array(result: Any, like: FloatArray, name: str, file: Path) -> FloatArray:
    try:
        array = np.asarray(result, dtype=float)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != like.shape or not np.isfinite(array).all():
        found = f"shape {array.shape}" if array.shape != like.shape else "values that are not finite"
        raise InputError(
            f"{name} gives something else", where=file, found=found, expected=f"{FUNCTIONS[name]}: here {like.shape}"
        )
    return array


def _add_forces(robot: Robot, function: Callable[..., Any], values: Mapping[str, Any], file: Path) -> Robot:
    nodes = robot.body.mesh.nodes
    forces = _array(_call(function, nodes, values, file), nodes, "forces", file)
    return robot.with_body(robot.body.with_dead_forces(robot.body.dead_forces + forces))


def _change(robot: Robot, function: Callable[..., Any], values: Mapping[str, Any], file: Path) -> Robot:
    changed = _call(function, robot, values, file)
    if not isinstance(changed, Robot):
        raise InputError("change gives something else", where=file, found=type(changed).__name__, expected=FUNCTIONS["change"])
    return changed


def _correct(robot: Robot, function: Callable[..., Any], values: Mapping[str, Any], file: Path) -> Robot:
    def correction(points: FloatArray) -> FloatArray:
        return _array(_call(function, points, values, file), points, "correct", file)

    correction(np.array([[0.0, 0.0, 0.5], [0.1, -0.1, 1.0]]))
    return replace(robot, observation=replace(robot.observation, corrections=(*robot.observation.corrections, correction)))


ACTIONS = {"forces": _add_forces, "change": _change, "correct": _correct}
