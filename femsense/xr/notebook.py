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
    """Show a run as an interactive 3-D view in a notebook: the deformed body and its contact forces over time.

    Write the call as the last expression of a cell. The page is served on 127.0.0.1, so the browser has to run on the same machine as the notebook's
    kernel; for a remote kernel forward the port of its address `url`.

    Arguments:
        run: result of `estimate` or `read_run`.
        height: height of the view [px].
        page: folder that contains the viewer's web page. Default: that of the installed package.

    Returns:
        the view, which Jupyter displays. The page is served as long as this object exists, or until its method `stop`.

    Raises:
        MissingDependency: this installation does not contain the viewer's web page; the message states how to get it.
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
