"""The viewer's page inside a notebook."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from femsense.xr.view import PAGE, ViewServer, serve

if TYPE_CHECKING:
    from femsense.sensing.types import Run


class Shown:
    """A page that a notebook shows in a frame; it is served for as long as this object lives, or until `stop`."""

    def __init__(self, server: ViewServer, scratch: tempfile.TemporaryDirectory[str], height: int) -> None:
        self.server, self.height = server, height
        self._scratch = scratch

    def __repr__(self) -> str:
        return f"Shown({self.url})"

    @property
    def url(self) -> str:
        """Address of the page."""
        return self.server.url

    def _repr_html_(self) -> str:
        """Return the frame that Jupyter shows."""
        style = f"width:100%;height:{self.height}px;border:0"
        return f'<iframe src="{self.url}" style="{style}" allow="xr-spatial-tracking; fullscreen" title="femsense"></iframe>'

    def stop(self) -> None:
        """Stop serving."""
        self.server.stop()
        self._scratch.cleanup()


def show_run(run: Run, *, height: int = 480, page: Path = PAGE) -> Shown:
    """Show a run in a notebook: the viewer page, as the last expression of a cell.

    The page is served on 127.0.0.1: the browser has to run on the same machine as the notebook's kernel.

    Arguments:
        run: result of `estimate`.
        height: height of the view [px].
        page: folder of the built page.

    Raises:
        MissingDependency: the page was not built into this installation.
    """
    from femsense.sensing.run_files import write_run

    scratch = tempfile.TemporaryDirectory(prefix="femsense-show-")
    try:
        folder = Path(scratch.name) / "run"
        write_run(run, folder, inputs={})
        return Shown(serve(folder, open_browser=False, page=page), scratch, height)
    except BaseException:
        scratch.cleanup()
        raise
