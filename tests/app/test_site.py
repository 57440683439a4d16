"""`femsense docs` finds pages by their names."""

from __future__ import annotations

from pathlib import Path

import pytest

from femsense.app.site import find_page, site_folder
from femsense.core.errors import InputError, MissingDependency


@pytest.fixture
def site(tmp_path: Path) -> Path:
    for page in (
        "index",
        "guides/statuses",
        "guides/forces",
        "reference/forces",
        "effects/creep",
        "effects/README",
        "_static/creep",
    ):
        file = tmp_path / "site" / f"{page}.html"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("page", encoding="utf-8")
    return tmp_path / "site"


@pytest.mark.parametrize(
    ("name", "page"),
    [
        (None, "index"),
        ("statuses", "guides/statuses"),
        ("creep", "effects/creep"),
        ("effects", "effects/README"),
        ("guides/forces", "guides/forces"),
        ("docs/effects/creep.md", "effects/creep"),
    ],
)
def test_a_page_is_found_by_its_path_or_by_the_end_of_it(site: Path, name: str | None, page: str) -> None:
    assert find_page(site, name) == site / f"{page}.html"


@pytest.mark.parametrize(
    ("name", "message"),
    [("statusses", "no such page(.|\n)*statuses"), ("forces", "several pages(.|\n)*guides/forces or reference/forces")],
)
def test_a_name_of_no_page_or_of_two_is_refused(site: Path, name: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        find_page(site, name)


def test_the_first_place_with_a_site_is_taken(site: Path, tmp_path: Path) -> None:
    assert site_folder([tmp_path / "none", site]) == site
    with pytest.raises(MissingDependency, match="make docs"):
        site_folder([tmp_path / "none"])
