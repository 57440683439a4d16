"""Pages: templates of Jinja, in which text is escaped unless it is `Markup`; one style sheet, no script, nothing from outside."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from femsense.report import words

FILTERS = (
    "counted",
    "entries",
    "frame_list",
    "interval",
    "joined",
    "nearly",
    "number",
    "parameter",
    "percent",
    "quantity",
    "signed",
    "statistic",
    "with_std",
)
"""Functions of `words` that templates use."""


@dataclass(frozen=True, slots=True)
class Chapter:
    """One part of a report."""

    title: str
    body: Markup
    headline: str = ""
    """Its result in one sentence."""
    subject: str = ""
    """The robot."""


def render(template: str, **values: Any) -> Markup:
    """Return a file of templates/ filled with values. Its filters are functions of `words` (`mm` is `length`)."""
    return Markup(_environment().get_template(template).render(values).strip())


@cache
def _environment() -> Environment:
    loader = PackageLoader("femsense.report")
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {name: getattr(words, name) for name in FILTERS} | {"mm": words.length}
    environment.tests["known"] = words.known
    return environment
