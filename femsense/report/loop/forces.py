"""What the effects mean for sensed forces."""

from __future__ import annotations

from collections.abc import Sequence

from femsense.report import words
from femsense.report.loop.evidence import Compliance, Forces, LoadRow
from femsense.report.page import Html, paragraph, table, together


def forces_part(forces: Forces) -> Html | None:
    """Return what the effects mean for sensed forces."""
    return _loads(forces.loads) if forces.loads else _softer(forces.compliance)


def _loads(loads: Sequence[LoadRow]) -> Html | None:
    several = len({row.recording for row in loads}) > 1
    rows = [
        [
            f"{row.recording + 1}: {row.frame}" if several else str(row.frame),
            words.quantity(row.declared_n, "N"),
            *_sensed(row.before_n, row.before_std_n, row.declared_n),
            *_sensed(row.after_n, row.after_std_n, row.declared_n),
        ]
        for row in loads
    ]
    held = all(row.held_out for row in loads)
    medians = [_median_error(loads, name) for name in ("before_n", "after_n")]
    text = paragraph(
        f"Sensed along the declared load, from the markers, to first order about the declared load, in "
        f"{'held-out' if held else 'fitted'} frames. "
        f"Median size of the error: {medians[0]} with the declared robot, calibrated; {medians[1]} with the improved one."
    )
    numbers = table(
        ("Recording: frame" if several else "Frame", "Declared load", "Declared robot", "error", "Improved robot", "error"),
        rows,
        caption="Forces at declared loads, ± one standard deviation from the noise of the markers, taken as independent.",
        numeric=(1, 2, 3, 4, 5),
    )
    return together(text, numbers)


def _sensed(value: float | None, std: float | None, declared: float | None) -> list[str]:
    if not words.known(value) or not words.known(declared) or not declared:
        return [words.with_std(value, std, "N"), words.NOTHING]
    assert value is not None
    return [words.with_std(value, std, "N"), words.joined(words.signed(100 * (value - declared) / declared), "%")]


def _median_error(loads: Sequence[LoadRow], name: str) -> str:
    import statistics

    gaps = [
        (abs(value - row.declared_n), abs(value - row.declared_n) / row.declared_n)
        for row in loads
        if words.known(value := getattr(row, name)) and words.known(row.declared_n) and row.declared_n
    ]
    if not gaps:
        return words.NOTHING
    size, share = (statistics.median(g[i] for g in gaps) for i in (0, 1))
    return f"{words.quantity(size, 'N', 2)} ({words.percent(share, 1)})"


def _softer(compliance: Compliance) -> Html | None:
    ratios = [r for frame in compliance.frames for r in frame.ratio if words.known(r) and r is not None]
    if not ratios:
        return None
    import statistics

    middle = statistics.median(ratios)
    text = paragraph(
        f"No load is declared in these frames. The same dent of the surface is sensed as {words.number(middle)} times "
        f"the force that the declared robot senses "
        f"(median over places and frames; {words.number(min(ratios))} to {words.number(max(ratios))}): compliance before "
        f"over compliance after."
    )
    rows = [
        [
            f"{frame.title} ({frame.frame})",
            _span(frame.ratio),
            words.quantity(frame.phantom_before_n, "N", 2),
            words.quantity(frame.phantom_after_n, "N", 2),
        ]
        for frame in compliance.frames
    ]
    numbers = table(
        ("Frame", "Force, improved over declared", "False force before", "after"),
        rows,
        caption="False force: what would have been sensed at the free end, where nothing touches, from the residual alone.",
        numeric=(1, 2, 3),
    )
    return together(text, numbers)


def _span(ratio: Sequence[float | None]) -> str:
    seen = sorted(r for r in ratio if words.known(r) and r is not None)
    return f"{words.number(seen[0])} … {words.number(seen[-1])}" if seen else words.NOTHING
