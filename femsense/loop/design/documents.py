"""Identifiability and proposals as plain tables."""

from __future__ import annotations

from typing import Any

from femsense.loop.design.identifiability import (
    Identifiability,
    Row,
)
from femsense.loop.design.planner import Proposal, pair_labels
from femsense.loop.verdict.candidate_tables import own_size


def identifiability_document(identifiability: Identifiability) -> dict[str, Any]:
    """Return the identifiability of an experiment as plain tables."""
    return {
        "effects": [_row_document(r) for r in identifiability.rows],
        "not_testable": identifiability.untestable,
        "not_seen": identifiability.unseen,
        "confounded": [
            {"pair": list(pair_labels(identifiability, p)), "cosine": p[2], "dbic_gap": p[3]} for p in identifiability.confused()
        ],
        "confusion": identifiability.confusion,
        "names": [r.label for r in identifiability.rows],
        "confounding": identifiability.confounding,
        "dbic_gap": identifiability.gap,
    }


def _row_document(r: Row) -> dict[str, Any]:
    f = r.form
    return {
        "name": r.label,
        "seed": f.seed,
        "retained_share": r.retained,
        "dbic": r.dbic,
        "would_be_seen": r.seen,
        "plausible": {
            p.label: {"change": _change(p, s), "unit": _unit(p)} for p, s in zip(f.parameters, f.size) if not f.effect.discrete
        },
        "smallest": {
            p.label: {"change": _change(p, s), "unit": _unit(p)}
            for p, s in zip(f.parameters, r.smallest)
            if not f.effect.discrete
        },
    }


def _change(p: Any, coordinate: float) -> float | None:
    """Return a size in the effect's own unit: a relative change for scales, the stiffness itself for compliances."""
    size = own_size(float(coordinate), p.scale)
    return size - 1.0 if size is not None and p.scale == "log" else size


def _unit(p: Any) -> str:
    return f"{p.unit} or softer" if p.scale == "reciprocal" else "share" if p.scale == "log" else str(p.unit)


def proposal_document(proposal: Proposal) -> dict[str, Any]:
    """Return a proposal as plain tables."""
    brings = {s.element.key: list(s.better) for s in proposal.steps}
    return {
        "noise_m": proposal.noise,
        "frames": sum(e.frames for e in proposal.elements),
        "seconds": sum(e.seconds for e in proposal.elements),
        "do": [
            {"key": e.key, "words": e.words, "frames": e.frames, "seconds": e.seconds, "brings": brings.get(e.key, [])}
            for e in proposal.elements
        ],
        "left_out": list(proposal.left_out),
        "before": identifiability_document(proposal.before),
        "after": identifiability_document(proposal.after),
    }
