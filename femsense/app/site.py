"""The site of this version: its folder, and its pages by name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from femsense.core.errors import InputError, MissingDependency
from femsense.core.text import did_you_mean

PACKAGE = Path(__file__).parents[1]
PLACES = (PACKAGE / "site", PACKAGE.parent / "build" / "site")
"""In an installed package, and in a checkout after `make docs`."""


def site_folder(places: Sequence[Path] = PLACES) -> Path:
    """Return the folder of the built site, the first of the places that holds one.

    Raises:
        MissingDependency: the site was not built.
    """
    for place in places:
        if (place / "index.html").is_file():
            return place
    raise MissingDependency(
        "this installation has no site\n"
        "  try:      in a checkout, make docs builds it into build/site; a wheel holds it unless it was built with FEMSENSE_SKIP_DOCS=1.\n"
        "            The sources of the pages are Markdown, in docs/ of the repository"
    )


def find_page(site: Path, name: str | None = None) -> Path:
    """Return the file of a page.

    Arguments:
        site: folder of the built site.
        name: its path without ending (`effects/creep`), the last part of it (`creep`), or a part of the site (`effects`); None: the home page.

    Raises:
        InputError: no such page, or several.
    """
    if name is None:
        return site / "index.html"
    wanted = name.strip("/").removesuffix(".html").removesuffix(".md").removeprefix("docs/")
    pages = {file.relative_to(site).with_suffix("").as_posix(): file for file in sorted(site.rglob("*.html"))}
    pages = {page: file for page, file in pages.items() if not page.startswith("_")}
    for page in (wanted, f"{wanted}/index", f"{wanted}/README"):
        if page in pages:
            return pages[page]
    found = [page for page in pages if page.endswith(f"/{wanted}")]
    if len(found) == 1:
        return pages[found[0]]
    if found:
        raise InputError("several pages have this name", where="PAGE", found=name, expected=" or ".join(found))
    near = did_you_mean(wanted.rpartition("/")[2], [page.rpartition("/")[2] for page in pages])
    raise InputError(
        "no such page", where="PAGE", found=name, expected="a page of the site", hint=near or "femsense docs opens its home page"
    )
