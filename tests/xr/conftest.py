"""The page, built once."""

from __future__ import annotations

from pathlib import Path

import pytest
from browser import page_folder


@pytest.fixture(scope="session")
def built_page(request: pytest.FixtureRequest) -> Path:
    """Folder of the bundled page."""
    return page_folder(request.config)
