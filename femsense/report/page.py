"""HTML: text is escaped unless it is `Html`; one style sheet, no script, nothing from outside."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

STYLE = """
:root { --ink: #1f252c; --soft: #5b6673; --line: #dfe3e8; --pale: #f5f7f9; --accent: #1f6f5c; --warn: #a8480c; }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0; background: #fff; color: var(--ink); font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto,
  "Helvetica Neue", Arial, sans-serif; overflow-wrap: break-word; }
main, header, footer { max-width: 1040px; margin: 0 auto; padding: 0 20px; }
header { padding-top: 34px; }
.kind { margin: 0; color: var(--soft); font-size: 14px; }
h1 { margin: 2px 0 0; font-size: 19px; font-weight: 600; }
.verdict { margin: 14px 0 22px; font-size: 27px; line-height: 1.3; font-weight: 600; letter-spacing: -0.01em; }
.verdict.long { font-size: 21px; }
h2 { margin: 52px 0 6px; padding-top: 14px; border-top: 2px solid var(--ink); font-size: 22px; line-height: 1.25; }
h3 { margin: 34px 0 6px; font-size: 17px; }
h4 { margin: 22px 0 4px; font-size: 15px; }
p { margin: 6px 0 10px; max-width: 74ch; }
ul { margin: 6px 0 10px; padding-left: 1.2em; max-width: 74ch; }
nav ul { padding: 0; list-style: none; display: flex; flex-wrap: wrap; gap: 4px 18px; max-width: none; font-size: 15px; }
a { color: var(--accent); }
code { font: 0.92em ui-monospace, SFMono-Regular, Menlo, Consolas, monospace; }
.soft { color: var(--soft); }
.value { min-width: 190px; overflow-wrap: anywhere; }
.next { border-left: 4px solid var(--accent); padding: 2px 0 2px 14px; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(170px, 1fr)); gap: 12px; margin: 14px 0 8px; }
.tile { margin: 0; background: var(--pale); border-radius: 8px; padding: 11px 14px 12px; break-inside: avoid; }
.tile dt { margin: 0; font-size: 13px; color: var(--soft); }
.tile dd { margin: 0; font-size: 24px; font-weight: 600; line-height: 1.25; }
.tile dd.note { font-size: 13px; font-weight: 400; color: var(--soft); }
.panels { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 400px), 1fr)); gap: 8px 24px; margin: 10px 0; }
figure { margin: 6px 0; break-inside: avoid; max-width: 560px; }
figure.wide { max-width: none; }
figure img { display: block; width: 100%; height: auto; }
figcaption { font-size: 14px; color: var(--soft); }
.scroll { overflow-x: auto; margin: 10px 0 14px; }
table { border-collapse: collapse; font-size: 14.5px; font-variant-numeric: tabular-nums; }
caption { text-align: left; color: var(--soft); font-size: 14px; padding-bottom: 4px; }
.cap { display: inline-block; position: sticky; left: 0; max-width: calc(100vw - 34px); }
tbody th .soft { min-width: 150px; font-weight: 400; } td:last-child:not(.n) { min-width: 130px; overflow-wrap: anywhere; }
th, td { text-align: left; vertical-align: top; padding: 5px 18px 5px 0; border-bottom: 1px solid var(--line); }
thead th { border-bottom: 1.5px solid var(--ink); font-weight: 600; vertical-align: bottom; }
tbody th { font-weight: 500; }
td.n, th.n { text-align: right; white-space: nowrap; } .dense th.n { white-space: normal; }
tr.strong th, tr.strong td { background: #eef6f3; }
footer { margin-top: 52px; padding-top: 12px; padding-bottom: 40px; color: var(--soft); font-size: 13px; }
@media (max-width: 1000px) {
  .dense table { font-size: 12.5px; } .dense th, .dense td { padding-right: 10px; }
  .dense .value { min-width: 120px; } .dense tbody th .soft, .dense td:last-child:not(.n) { min-width: 100px; }
}
@media (max-width: 560px) {
  main, header, footer { padding-left: 14px; padding-right: 14px; }
  .verdict { font-size: 22px; } .verdict.long { font-size: 18px; }
  .tiles { grid-template-columns: 1fr 1fr; gap: 8px; } .tile dd { font-size: 20px; }
  th, td { padding-right: 13px; }
}
@media print {
  @page { margin: 16mm 14mm; }
  body { font-size: 10.5pt; } main, header, footer { max-width: none; padding: 0; }
  .verdict { font-size: 17pt; } .verdict.long { font-size: 14pt; }
  .tiles { grid-template-columns: repeat(4, 1fr); } .tile { border: 1px solid var(--line); } .tile dd { font-size: 15pt; }
  .panels { grid-template-columns: 1fr 1fr; } .scroll { overflow: visible; } table { font-size: 9pt; }
  th, td { padding-right: 9pt; } thead { display: table-header-group; } tr { break-inside: avoid; }
  h2, h3, h4, caption { break-after: avoid; } .value { min-width: 30mm; }
  tbody th .soft { min-width: 26mm; } td:last-child:not(.n) { min-width: 26mm; } nav { display: none; }
}
"""
BLOCKS = {"p", "div", "dl", "dt", "dd", "li", "th", "td", "tr", "caption", "figcaption", "h1", "h2", "h3", "h4", "title"}
"""Elements that end a line of the file."""
NEWLINE = "\n"
LONG = 150
"""A sentence of more letters is set smaller."""


class Html(str):
    """Text that is HTML already."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class Chapter:
    """One part of a report."""

    title: str
    body: Html
    headline: str = ""
    """Its result in one sentence."""
    subject: str = ""
    """The robot."""


@dataclass(frozen=True, slots=True)
class Cell:
    """A cell that spans several rows."""

    content: Any
    rows: int


def escape(value: object) -> Html:
    """Return a value as HTML: text is escaped, `Html` stays."""
    return value if isinstance(value, Html) else Html(html.escape(str(value), quote=True))


def element(tag: str, *contents: object, **attributes: str) -> Html:
    """Return an element; `class_` gives its class."""
    names = "".join(f' {name.rstrip("_").replace("_", "-")}="{escape(value)}"' for name, value in attributes.items())
    return Html(f"<{tag}{names}>{''.join(map(escape, contents))}</{tag}>{NEWLINE if tag in BLOCKS else ''}")


def together(*parts: Html | None) -> Html:
    """Return parts one after the other; those that are None are left out."""
    return Html("\n".join(part for part in parts if part))


def paragraph(*contents: object, class_: str | None = None) -> Html:
    """Return a paragraph."""
    return element("p", *contents, class_=class_) if class_ else element("p", *contents)


def code(text: object) -> Html:
    """Return a name as it stands in files."""
    return element("code", text)


def bullets(items: Sequence[object]) -> Html | None:
    """Return a list; None where it is empty."""
    return element("ul", *(element("li", item) for item in items)) if items else None


def section(title: str, *parts: Html | None, level: int = 3) -> Html | None:
    """Return a titled section; None where all its parts are missing."""
    body = together(*parts)
    return together(element(f"h{level}", title), body) if body else None


def tiles(items: Sequence[tuple[str, str, str]]) -> Html:
    """Return figures in large type: title, value and a note below each."""
    blocks = []
    for title, value, note in items:
        parts = [element("dt", title), element("dd", value), *([element("dd", note, class_="note")] if note else [])]
        blocks.append(element("dl", *parts, class_="tile"))
    return element("div", *blocks, class_="tiles")


def table(
    headers: Sequence[str],
    rows: Sequence[Sequence[Any]],
    *,
    caption: str,
    numeric: Sequence[int] = (),
    strong: Sequence[int] = (),
    dense: bool = False,
) -> Html | None:
    """Return a table that scrolls by itself where the page is narrow; None where it has no rows.

    Arguments:
        headers: of the columns.
        rows: cells; the first of each row is its header, `None` a place that a `Cell` of an earlier row covers.
        caption: what the table shows.
        numeric: columns that are aligned to the right.
        strong: rows that stand out.
        dense: with many columns, so that headers break, too.
    """
    if not rows:
        return None
    head = element("tr", *(_cell("th", text, j in numeric, scope="col") for j, text in enumerate(headers)))
    lines = [
        element("tr", *_row(row, numeric), class_="strong") if i in strong else element("tr", *_row(row, numeric))
        for i, row in enumerate(rows)
    ]
    whole = element(
        "table",
        element("caption", element("span", caption, class_="cap")),
        element("thead", head),
        element("tbody", together(*lines)),
    )
    return element("div", whole, class_="scroll dense" if dense else "scroll", tabindex="0", role="region", aria_label=caption)


def _row(row: Sequence[Any], numeric: Sequence[int]) -> list[Html]:
    cells = []
    for j, content in enumerate(row):
        if content is None:
            continue
        span = {"rowspan": str(content.rows)} if isinstance(content, Cell) and content.rows > 1 else {}
        text = content.content if isinstance(content, Cell) else content
        cells.append(_cell("td" if j else "th", text, j in numeric, **({} if j else {"scope": "row"}), **span))
    return cells


def _cell(tag: str, content: object, numeric: bool, **attributes: str) -> Html:
    return element(tag, content, **({"class_": "n"} if numeric else {}), **attributes)


def image(data: bytes, kind: str, *, alt: str, caption: object = "", wide: bool = False) -> Html:
    """Return a figure with the picture inside the page.

    Arguments:
        data: the picture.
        kind: "svg+xml" or "png".
        alt: what it shows, for those who do not see it.
        caption: stands below it.
        wide: over the whole width of the page.
    """
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
    picture = Html(f'<img src="{source}" alt="{escape(alt)}">')
    return element(
        "figure", picture, *([element("figcaption", caption)] if caption else []), **({"class_": "wide"} if wide else {})
    )


def panels(*figures: Html | None) -> Html | None:
    """Return figures beside each other, below each other where the page is narrow."""
    there = [figure for figure in figures if figure]
    return element("div", *there, class_="panels") if there else None


def page(title: str, kind: str, chapters: Sequence[Chapter]) -> str:
    """Return the whole document.

    Arguments:
        title: on top, and of the window.
        kind: a line above it.
        chapters: the first one's headline stands on top in large type.
    """
    names = [f"part-{i + 1}" for i in range(len(chapters))]
    links = [element("li", element("a", chapter.title, href=f"#{name}")) for chapter, name in zip(chapters, names)]
    contents = element("nav", element("ul", *links), aria_label="Contents") if len(chapters) > 1 else None
    verdict = chapters[0].headline
    size = "verdict long" if len(verdict) > LONG else "verdict"
    top = together(
        paragraph(kind, class_="kind"), element("h1", title), paragraph(verdict, class_=size) if verdict else None, contents
    )
    body = together(
        *(
            _chapter(chapter, name, lead=i == 0, alone=len(chapters) == 1)
            for i, (chapter, name) in enumerate(zip(chapters, names))
        )
    )
    head = (
        f'<meta charset="utf-8">\n<meta name="viewport" content="width=device-width, '
        f'initial-scale=1">\n<meta name="generator" content="femsense">\n<title>{escape(title)}</title>\n<style>{STYLE}</style>'
    )
    foot = element("footer", "Lengths are 3-D distances unless the text says otherwise; ± is one standard deviation.")
    return (
        f"<!DOCTYPE html>\n<html "
        f'lang="en">\n<head>\n{head}\n</head>\n<body>\n{element("header", top)}\n{element("main", body)}\n{foot}\n</body>\n</html>\n'
    )


def _chapter(chapter: Chapter, name: str, *, lead: bool, alone: bool) -> Html:
    title = None if alone else element("h2", chapter.title)
    headline = None if lead or not chapter.headline else paragraph(element("strong", chapter.headline))
    return element("section", together(title, headline, chapter.body), id=name)
