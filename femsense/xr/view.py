"""The page for browsers and headsets, served from a run folder."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable
from functools import cache, partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

from femsense.core.errors import FemsenseError, InputError, MissingDependency
from femsense.io.files import check_target, followed
from femsense.io.own_files import VIEW, check_files
from femsense.xr.run_contents import contacts_of_run, current_glb, run_folder, stress_of_run

PAGE = Path(__file__).with_name("viewer") / "dist"
Content = Path | bytes | Callable[[], bytes]
"""A served file: its path, its content, or a function that creates it on request."""
TYPES = {".glb": "model/gltf-binary", ".js": "text/javascript", ".json": "application/json"}


class ViewServer(ThreadingHTTPServer):
    """Serves the page of one run; a context manager that stops and tidies up at its end."""

    daemon_threads = True

    def __init__(self, address: tuple[str, int], files: dict[str, Content], scratch: tempfile.TemporaryDirectory[str]) -> None:
        self.files = files
        self.scratch = scratch
        super().__init__(address, _Handler)
        self._thread = Thread(target=partial(self.serve_forever, poll_interval=0.1), daemon=True)

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://127.0.0.1:{self.server_address[1]}/"

    def start(self) -> None:
        """Answer requests in a thread of its own."""
        self._thread.start()

    def wait(self) -> None:
        """Return when the server has been stopped."""
        while self._thread.is_alive():
            self._thread.join(0.5)

    def stop(self) -> None:
        """Stop answering, free the port, remove temporary files."""
        if self._thread.ident is not None:  # after an interrupted `wait`, is_alive() of the thread is wrong
            self.shutdown()
        self.server_close()
        self.scratch.cleanup()

    def __exit__(self, *_: object) -> None:
        self.stop()


def serve(folder: str | Path, *, port: int = 0, open_browser: bool = True, page: Path = PAGE) -> ViewServer:
    """Serve the page of a run on 127.0.0.1 and return immediately.

    Arguments:
        folder: contains `states.npz`, and `contacts.csv` and `frames.csv` if there are contacts. `robot.glb` is
            created if it is missing or older than the states, in a temporary folder if the run is read-only.
        port: 0 selects a free one.
        open_browser: open the page in the default browser.
        page: folder of the built page.

    Returns:
        the running server: `.url`, `.wait()`, `.stop()`; also a context manager.

    Raises:
        MissingDependency: the page was not built into this installation.
        InputError: no readable states in the folder, or the port is taken.
    """
    built = page_files(page)
    run = run_folder(folder)
    scratch = tempfile.TemporaryDirectory(prefix="femsense-view-")
    try:
        glb = current_glb(run, Path(scratch.name))
        files: dict[str, Content] = {**built, "robot.glb": glb, "contacts.json": _json(contacts_of_run(run))}
        files["fields.bin"] = cache(partial(_stress, run, glb))
        server = ViewServer(("127.0.0.1", port), files, scratch)
    except OSError as error:
        scratch.cleanup()
        raise InputError("the page cannot be served", where=f"port {port}", found=error, hint="port 0 takes a free one") from None
    except BaseException:
        scratch.cleanup()
        raise
    server.start()
    if open_browser:
        import webbrowser

        webbrowser.open(server.url)
    return server


def write_static_page(folder: str | Path, out_dir: str | Path, *, page: Path = PAGE) -> Path:
    """Write page, mesh and contacts into a folder that any web server can serve; return the path of its `index.html`.

    `page` is the folder of the built page. Raises as `serve`.
    """
    files = page_files(page)
    run = run_folder(folder)
    out = Path(out_dir)
    check_target(out, folder=True)
    check_files(followed(out), VIEW)
    foreign = [name for name in (*files, "fields.bin") if (out / name).exists() and not (out / "contacts.json").is_file()]
    if foreign:
        raise InputError(
            "the folder contains other files",
            where=out,
            found=", ".join(foreign),
            expected="a folder of its own",
            hint="another -o",
        )
    followed(out).mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="femsense-view-") as scratch:
        glb = current_glb(run, Path(scratch))
        for name, source in files.items():
            shutil.copyfile(source, out / name)
        if glb.resolve() != (out / "robot.glb").resolve():
            shutil.copyfile(glb, out / "robot.glb")
        (out / "fields.bin").write_bytes(_stress(run, glb))
    (out / "contacts.json").write_bytes(_json(contacts_of_run(run)))
    return out / "index.html"


# ---- the page --------------------------------------------------------------------------------------------------------------


def page_files(page: Path) -> dict[str, Path]:
    """Return the files of a built page by name. Raises MissingDependency."""
    if not (page / "index.html").is_file():
        raise MissingDependency(
            "the viewer page was not built into this installation (its build was skipped, or the sources are used without "
            "installing them)\n  try:      pip install --force-reinstall --no-deps femsense, or in a checkout: pip install -e ."
        )
    return {path.name: path for path in sorted(page.iterdir()) if path.is_file() and not path.name.startswith(".")}


def live_page_files(page: Path) -> dict[str, Path | bytes]:
    """Return the same for a page that also shows a live stream. Raises MissingDependency."""
    files: dict[str, Path | bytes] = {**page_files(page)}
    index = (page / "index.html").read_text(encoding="utf-8")
    files["index.html"] = index.replace("<html ", '<html data-mode="live" ', 1).encode()
    return files


def _stress(run: Path, glb: Path) -> bytes:
    return stress_of_run(run, glb.read_bytes()).to_bytes()


def _json(value: dict[str, Any]) -> bytes:
    return json.dumps(value, allow_nan=False, separators=(",", ":")).encode()


class _Handler(SimpleHTTPRequestHandler):
    """Serves the files of the page, and no other file of this machine."""

    server: ViewServer

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def _answer(self, *, with_body: bool) -> None:
        name = self.path.split("?", 1)[0].split("#", 1)[0].lstrip("/") or "index.html"
        content = self.server.files.get(name)
        try:
            data = content.read_bytes() if isinstance(content, Path) else content() if callable(content) else content
        except (OSError, FemsenseError):
            data = None
        if data is None:
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Type", TYPES.get(Path(name).suffix) or self.guess_type(name))
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Cache-Control", "no-cache")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        if with_body:
            self.wfile.write(data)

    def log_message(self, format: str, *args: object) -> None:
        """Suppress the library's log output."""
