"""Numbers and names as people read them: mm, N or mN, as many digits as the uncertainty allows, "–" for unknown values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from femsense.core.text import numbers_text
from femsense.loop.result.loop_result import Verdict

NOTHING = "–"
VERDICTS: dict[str, str] = {
    Verdict.FOUND: "the data name what the model lacks",
    Verdict.NONE: "the model explains the data to their noise",
    Verdict.UNEXPLAINED: "a residual remains that no effect explains",
}
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
UNITS = {"m": (1e3, "mm"), "Pa": (1e-3, "kPa"), "rad": (180.0 / math.pi, "°"), "1": (1.0, "")}
"""Unit of the files → factor and name of the unit that is shown."""
MILLI = 0.1
"""Forces below this [N] are shown in mN."""
NIL = 1e-4
"""Differences of χ² below this are rounding errors."""
HUGE = 1e6
"""Standard deviations of at least this are shown as powers of ten."""


def known(value: Any) -> bool:
    """Return whether a value is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def number(value: Any, digits: int = 3) -> str:
    """Return a number with some significant digits, "–" for None and NaN."""
    if not known(value):
        return NOTHING
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if not -4 <= exponent < 6:
        mantissa, power = f"{value:.{digits - 1}e}".split("e")
        return _minus(f"{mantissa} × 10{str(int(power)).translate(SUPERSCRIPT)}")
    return _minus(f"{value:.{max(0, digits - 1 - exponent)}f}")


def quantity(value: Any, unit: str | None, digits: int = 3) -> str:
    """Return a number of SI with the unit that it is shown in."""
    factor, name = UNITS.get(unit or "1", (1.0, unit or ""))
    return joined(number(factor * value, digits), name) if known(value) else NOTHING


def length(value_m: Any, digits: int = 3) -> str:
    """Return a length in mm; below 0.1 mm two digits are enough."""
    return quantity(value_m, "m", min(digits, 2) if known(value_m) and abs(value_m) < 1e-4 else digits)


def percent(share: Any, digits: int = 0) -> str:
    """Return a share in percent."""
    return joined(_minus(f"{100 * share:.{digits}f}"), "%") if known(share) else NOTHING


def nearly(share: Any, digits: int = 0) -> str:
    """Return a share in percent; one that is nearly the whole is not rounded up to it."""
    most = 1.0 - 10.0 ** (-2 - digits)
    return f"more than {percent(most, digits)}" if known(share) and share > most else percent(share, digits)


def statistic(value: Any, digits: int = 3) -> str:
    """Return a difference of χ² or BIC; one within the rounding error is 0."""
    return "0" if known(value) and abs(value) < NIL else number(value, digits)


def signed(value: Any) -> str:
    """Return a number with its sign, also where it is positive."""
    text = number(value, 2)
    return f"+{text}" if known(value) and value > 0 else text


def force_unit(largest_n: float) -> tuple[float, str]:
    """Return factor and name of the unit for forces up to a size [N]."""
    return (1e3, "mN") if 0 < largest_n < MILLI else (1.0, "N")


def with_std(value: Any, std: Any, unit: str | None = None) -> str:
    """Return value ± standard deviation with its unit; the deviation has two significant digits, and the value as many decimals."""
    if isinstance(value, str | bool):
        return str(value)
    factor, name = UNITS.get(unit or "1", (1.0, unit or ""))
    if not known(value) or not known(std) or std <= 0:
        return quantity(value, unit)
    value, std = factor * value, factor * std
    decimals = 1 - math.floor(math.log10(std))
    if decimals > 6 or std >= HUGE:
        return joined(f"{number(value)} ± {number(std, 2)}", name)
    shown = max(0, decimals)
    value = round(value, shown) + 0.0  # no minus before a zero
    return joined(_minus(f"{value:.{shown}f} ± {std:.{shown}f}"), name)


def interval(ends_m: Sequence[Any] | None) -> str:
    """Return an interval of lengths in mm."""
    if not ends_m or len(ends_m) != 2 or not all(map(known, ends_m)):
        return NOTHING
    return f"{number(1e3 * ends_m[0])} … {number(1e3 * ends_m[1])} mm"


def entries(value: Any, std: Any) -> list[tuple[str, Any, Any]]:
    """Return the named parts of a value with their standard deviations: the entries of a table, else the value with an empty name."""
    if not isinstance(value, Mapping):
        return [("", value, std)]
    deviations = std if isinstance(std, Mapping) else {}
    return [(str(name), part, deviations.get(name)) for name, part in value.items()]


def parameter(value: Any, std: Any, unit: str | None) -> str:
    """Return a number or a vector ± standard deviation."""
    if not isinstance(value, list | tuple):
        return with_std(value, std, unit)
    deviations = std if isinstance(std, list | tuple) and len(std) == len(value) else [None] * len(value)
    name = UNITS.get(unit or "1", (1.0, unit or ""))[1]
    parts = [with_std(v, s, unit).removesuffix(name).strip() if name else with_std(v, s, unit) for v, s in zip(value, deviations)]
    return joined(f"({', '.join(parts)})", name)


def frame_list(frames: Sequence[int]) -> str:
    """Return numbers of frames with runs drawn together: 0–3, 7."""
    return numbers_text(sorted(set(frames))) or "none"


def joined(text: str, unit: str) -> str:
    """Return a number and its unit with a space between them that does not break."""
    return f"{text}\u00a0{unit}" if unit and text != NOTHING else text


def counted(count: int, noun: str) -> str:
    """Return a count with its noun: 1 frame, 2 frames."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def duration(seconds: float) -> str:
    """Return a time in seconds, minutes or hours."""
    if seconds < 100:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def _minus(text: str) -> str:
    return text.replace("-", "−")


def sentence(text: str) -> str:
    """Return words as a sentence of their own."""
    return f"{text[0].upper()}{text[1:]}." if text else ""
