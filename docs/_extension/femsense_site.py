"""What the site needs beyond Sphinx: MathML, the reference of the commands, plain docstrings, and llms.txt.

MathML is rendered by the browser itself, so pages with equations need no script and no network.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Any

import latex2mathml.converter
import typer.main
from docutils import nodes
from sphinx.addnodes import desc_annotation, pending_xref_condition
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

from femsense.app.cli import COMMANDS, app

FIELDS: dict[str, list[str]] = {}
"""Qualified name of a field → its text."""
logger = logging.getLogger(__name__)
SUMMARY = """# femsense

> An ordinary depth camera as a force sensor for soft robots: femsense fits a finite-element model of the robot to what the camera sees and
> reports where something pushes, how hard, and with which standard deviation. `femsense improve` finds what the model itself lacks.

Python 3.11 and 3.12; SI units; command line and Python. Each link leads to a page as Markdown.
"""


ARRAY_LIKE = re.compile(r"~?[\w.]*_Buffer \| ~?[\w.]*_SupportsArray.*?_NestedSequence\[complex \| bytes \| str\]", re.DOTALL)
"""What Sphinx makes of npt.ArrayLike."""
ALIGNED = re.compile(r"\\begin\{(aligned|align\*?|split)\}(.*?)\\end\{\1\}", re.DOTALL)


def mathml(latex: str, display: str) -> str:
    """Return LaTeX as MathML; aligned equations become a table whose columns the style sheet aligns (browsers ignore `columnalign`)."""
    aligned = ALIGNED.search(latex) is not None
    latex = ALIGNED.sub(r"\\begin{matrix}\2\\end{matrix}", latex)
    found = latex2mathml.converter.convert(" ".join(latex.split()), display=display)
    if unknown := sorted(set(re.findall(r"\\[A-Za-z]+", found))):
        logger.warning("LaTeX that MathML does not have: %s in %s", ", ".join(unknown), latex)
    return found.replace("<mtable", '<mtable class="aligned" displaystyle="true"') if aligned else found


def inline_math(translator: Any, node: nodes.math) -> None:
    translator.body.append(mathml(node.astext(), "inline"))
    raise nodes.SkipNode


def display_math(translator: Any, node: nodes.math_block) -> None:
    number = f'<span class="eqno">({node["number"]})</span>' if node.get("number") else ""
    translator.body.append(f'<div class="math">{number}{mathml(node.astext(), "block")}</div>\n')
    raise nodes.SkipNode


class Commands(SphinxDirective):
    """Lists each command of the command line with its arguments, options, defaults and example, from the program itself."""

    def run(self) -> list[nodes.Node]:
        commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
        text = "\n".join(line for name, command in commands.items() for line in command_page(name, command))
        return self.parse_text_to_nodes(text, allow_section_headings=True)


def command_page(name: str, command: Any) -> Iterator[str]:
    """Yield the Markdown of a command."""
    usage = [part for p in command.params if p.param_type_name == "argument" for part in [p.metavar or p.name.upper()]]
    yield f"(command-{name})=\n## femsense {name}\n"
    yield f"{(command.help or '').strip()}\n"
    yield f"```text\nfemsense {' '.join([name, *usage])} [OPTIONS]\n```\n"
    yield "| argument, option | meaning |\n|---|---|"
    for parameter in command.params:
        yield f"| {_name(parameter)} | {_cell(parameter.help)}{_default(parameter)} |"
    yield f"\nExample:\n\n```sh\n{COMMANDS[name][1]}\n```"
    yield ""


def _name(parameter: Any) -> str:
    """Return how a table names a parameter: an argument by its word, an option by its flags and what it takes."""
    if parameter.param_type_name == "argument":
        return f"`{_cell(parameter.metavar or parameter.name.upper())}`"
    flags = ", ".join(f"`{flag}`" for flag in [*parameter.opts, *parameter.secondary_opts])
    type_ = parameter.type_descriptor.annotation
    choices = "|".join(choice.value for choice in type_) if isinstance(type_, type) and issubclass(type_, Enum) else None
    takes = parameter.metavar or choices
    return f"{flags} `{_cell(takes)}`" if takes else flags


def _cell(text: str | None) -> str:
    return " ".join((text or "").split()).replace("|", r"\|")


def _default(parameter: Any) -> str:
    value = getattr(parameter.default, "value", parameter.default)
    plain = not isinstance(value, bool) and isinstance(value, (str, int, float, Path)) and value != ""
    return f" Default: `{value}`." if plain else ""


def plain_docstring(sphinx: Sphinx, what: str, name: str, _: Any, __: Any, lines: list[str]) -> None:
    """Escape what reStructuredText would take for markup: docstrings here are plain text with `names` in backquotes."""
    for i, line in enumerate(lines):
        if line.lstrip().startswith((">>>", "...")):
            continue
        parts = re.split(r"(``[^`]*``|`[^`]*`)", line)
        lines[i] = "".join(
            part if part.startswith("`") else re.sub(r"(?<=\w)_(?=\W|$)", r"\_", re.sub(r"([*|])", r"\\\1", part))
            for part in parts
        )
    if what in ("attribute", "property", "data"):
        FIELDS[name] = list(lines)


def plain_field(_: Sphinx, what: str, name: str, __: Any, ___: Any, lines: list[str]) -> None:
    """Put the text of a field back: napoleon takes what stands before a colon for its type."""
    if what in ("attribute", "property", "data"):
        lines[:] = FIELDS.pop(name)


def plain_signature(*event: Any) -> tuple[str | None, str | None]:
    """Return a signature with the names of array types as the source has them, and ... for defaults that are not literals."""
    *_, signature, returns = event
    return _plain(signature), _plain(returns)


def _plain(text: str | None) -> str | None:
    if text is None:
        return None
    text = ARRAY_LIKE.sub("ArrayLike", text)
    text = re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", text)
    text = re.sub(r", ~?[\w.]*(?:Before|After|Plain|Wrap)Validator\((?:[^()]|\([^()]*\))*\)", "", text)
    text = re.sub(r"~?[\w.]*Annotated\[([^\[\],]+(?:\[[^\[\]]*\])?)\]", r"\1", text)
    return re.sub(r"= <(?:[^<>]|<[^<>]*>)*>", "= ...", text)


def plain_annotations(_: Sphinx, page: nodes.document) -> None:
    """Write the types of fields as the source has them."""
    for node in page.findall(desc_annotation):
        once = node.deepcopy()  # a name stands twice in it: as it is shown, and as it is shown if its link is found
        for twice in list(once.findall(lambda one: isinstance(one, pending_xref_condition) and one["condition"] == "resolved")):
            twice.parent.remove(twice)
        if ARRAY_LIKE.search(text := once.astext()):
            node.clear()
            node += nodes.Text(ARRAY_LIKE.sub("ArrayLike", text))


def write_llms(sphinx: Sphinx, failure: Exception | None) -> None:
    """Write llms.txt (llmstxt.org): what femsense is, and every page with its first sentence, by parts of the site."""
    if failure is not None or sphinx.builder.name != "html":
        return
    env, parts = sphinx.env, [SUMMARY]
    for part in env.toctree_includes.get("index", []):
        parts.append(f"\n## {env.titles[part].astext()}\n")
        for page in _below(env, part):
            source = Path(env.doc2path(page)).read_text(encoding="utf-8")
            parts.append(f"- [{env.titles[page].astext()}](_sources/{page}.md.txt): {first_sentence(source)}")
    Path(sphinx.outdir, "llms.txt").write_text("\n".join(parts) + "\n", encoding="utf-8")


def _below(env: Any, page: str) -> Iterator[str]:
    yield page
    for inner in env.toctree_includes.get(page, []):
        yield from _below(env, inner)


def first_sentence(source: str) -> str:
    """Return the first sentence of the first paragraph of a page in Markdown."""
    source = re.sub(r"^(```|:::).*?^\1[^\n]*$", "", source, flags=re.MULTILINE | re.DOTALL)
    for paragraph in source.split("\n\n"):
        text = " ".join(paragraph.split())
        if text and text[0] not in "#|<!:({+-" and not text.startswith("```"):
            text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text.replace("**", ""))
            return re.split(r"(?<=[.:?]) ", text)[0]
    return ""


def setup(sphinx: Sphinx) -> dict[str, Any]:
    sphinx.add_html_math_renderer("mathml", (inline_math, None), (display_math, None))
    sphinx.add_directive("commands", Commands)
    sphinx.connect("autodoc-process-docstring", plain_docstring, priority=400)
    sphinx.connect("autodoc-process-docstring", plain_field, priority=600)
    sphinx.connect("autodoc-process-signature", plain_signature)
    sphinx.connect("doctree-read", plain_annotations)
    sphinx.connect("build-finished", write_llms)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
