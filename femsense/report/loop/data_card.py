"""What a loop rests on: frames, noise, weights, versions, hashes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from femsense.report import words
from femsense.report.loop.document import Card, Loop, LoopInputs, Outlier
from femsense.report.loop.evidence import Evidence
from femsense.report.page import Html, code, element, table, together

COMPONENTS = {
    "white": "each measurement by itself",
    "state": "a marker in a repeated state",
    "marker": "a marker on the body, in all frames",
    "frame": "all markers of a frame",
    "sweep": "all frames of a sweep",
}
OUTLIERS = 6


def _outlier_list(outliers: Sequence[Outlier]) -> str:
    said = ", ".join(f"{s.marker} in frame {s.frame}" for s in outliers[:OUTLIERS])
    return f"{said} … ({len(outliers)})" if len(outliers) > OUTLIERS else said


def data_card(loop: Loop) -> Html | None:
    """Return what the result rests on."""
    card, evidence = loop.data, loop.evidence or Evidence()
    rows: list[list[object]] = []
    for i, how in enumerate(card.split):
        name = Path(card.recordings[i] or "").name if i < len(card.recordings) else ""
        rows.append([f"Split, recording {i + 1}" + (f" ({name})" if name and name != "None" else ""), how])
    for title, groups in (("Frames fitted", card.frames_fitted), ("Frames held out", card.frames_held_out)):
        rows += [
            [f"{title}{f', {i + 1}' if len(groups) > 1 else ''}", f"{words.frame_list(g)} ({len(g)})"]
            for i, g in enumerate(groups)
        ]
    for i, reasons in enumerate(evidence.excluded):
        lines = [element("div", f"{why}: {words.frame_list(g)} ({len(g)})") for why, g in reasons.items() if g]
        rows.append(
            [f"Frames left out{f', {i + 1}' if len(evidence.excluded) > 1 else ''}", together(*lines) if lines else "none"]
        )
    rows += [["Outliers left out", _outlier_list(card.outliers)]] if card.outliers else []
    rows += [["Repeats (a state reached again the same way)", str(evidence.repeats)]] if evidence.repeats is not None else []
    rows += _noise_rows(card, loop.model_error.discretisation_note)
    for name, parameters in card.nuisance_after.items():
        rows.append([element("span", "Fitted along: ", code(name)), together(*_nuisance_lines(parameters))])
    rows += [["Seed", str(card.seed)]] if card.seed is not None else []
    rows += [["Versions", ", ".join(f"{name} {version}" for name, version in loop.versions.items())]] if loop.versions else []
    rows += _hash_rows(loop.inputs)
    return table(("Item", "Value"), rows, caption="What the result rests on; loop.json beside this file holds all of it.")


def _noise_rows(card: Card, no_mesh: str) -> list[list[object]]:
    """Return rows on noise and weights; `no_mesh` says why the discretisation error is not known."""
    noise = [f"{COMPONENTS.get(name, name)} {words.length(std)}" for name, std in card.noise_components_m.items()]
    rows: list[list[object]] = [["Weights of the fit, each axis", "; ".join(noise)]] if noise else []
    rows += [["Source of the noise level", card.noise_source]] if card.noise_source else []
    rows += (
        [["Independent observations", words.number(card.effective_observations)]]
        if words.known(card.effective_observations)
        else []
    )
    mesh = words.length(card.mesh_error_m, 2) if words.known(card.mesh_error_m) else no_mesh
    rows += [["Error of the mesh, at the markers", mesh]] if mesh else []
    if card.clouds is not None:
        clouds = card.clouds
        rows.append(["Clouds", f"{sum(clouds.rows)} rows along normals in {sum(clouds.frames)} fitted frames"])
        if "markers" in card.measured:
            own = [f"{COMPONENTS.get(name, name)} {words.length(std)}" for name, std in clouds.noise_components_m.items()]
            rows.append(["Noise of clouds, along the normal", "; ".join(own)])
    if "markers" not in card.measured:
        return [
            [str(a).replace("each axis", "along the normal").replace("at the markers", "along the normals"), b] for a, b in rows
        ]
    rows += (
        [["Uncertainty of marker placement", words.length(card.placement_std_m, 2)]] if words.known(card.placement_std_m) else []
    )
    return rows


def _nuisance_lines(parameters: Mapping[str, Any]) -> list[Html]:
    return [
        element("div", code(f"{key} {name}".strip()), f" {words.parameter(value, std, p.unit)}")
        for key, p in parameters.items()
        for name, value, std in words.entries(p.value, p.std)
    ]


def _hash_rows(inputs: LoopInputs) -> list[list[object]]:
    named = [
        ("Robot", inputs.robot),
        *((f"Recording {i + 1}", r) for i, r in enumerate(inputs.recordings)),
        *((f"Validation {i + 1}", r) for i, r in enumerate(inputs.validation)),
    ]
    lines = [
        element("div", f"{title} {Path(item.path).name if item.path else ''} ", code(item.sha256[:16]))
        for title, item in named
        if item.sha256
    ]
    return [["SHA-256 of the inputs (first digits)", together(*lines)]] if lines else []
