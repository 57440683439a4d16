"""The page for browsers and headsets, served from a run folder."""

from __future__ import annotations

import csv
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterable
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError, MissingDependency
from femsense.xr.gltf import ExportReport, export_states

PAGE = Path(__file__).with_name("viewer") / "dist"
FORMAT = "femsense-contacts-1"
TYPES = {".glb": "model/gltf-binary", ".js": "text/javascript", ".json": "application/json"}


class ViewServer(ThreadingHTTPServer):
    """Serves the page of one run; a context manager that stops and tidies up at its end."""

    daemon_threads = True

    def __init__(
        self, address: tuple[str, int], files: dict[str, Path | bytes], scratch: tempfile.TemporaryDirectory[str]
    ) -> None:
        self.files = files
        self.scratch = scratch
        super().__init__(address, _Handler)
        self._thread = Thread(target=partial(self.serve_forever, poll_interval=0.1), daemon=True)

    @property
    def url(self) -> str:
        """Where the page is."""
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
        if self._thread.is_alive():
            self.shutdown()
        self.server_close()
        self.scratch.cleanup()

    def __exit__(self, *_: object) -> None:
        self.stop()


def serve(run_folder: str | Path, *, port: int = 0, open_browser: bool = True, page: Path = PAGE) -> ViewServer:
    """Start the page of a run on 127.0.0.1 and return at once.

    Arguments:
        run_folder: holds `states.npz`, and `contacts.csv` and `frames.csv` where there are contacts. `robot.glb` is
            made where it is missing or older than the states; in a temporary place where the folder cannot be written.
        port: 0 takes a free one.
        open_browser: shows the page in the default browser.
        page: folder of the built page.

    Returns:
        the running server: `.url`, `.wait()`, `.stop()`; also a context manager.

    Raises:
        MissingDependency: the page was not built into this installation.
        InputError: no readable states in the folder, or the port is taken.
    """
    built = _page_files(page)
    run = _as_run_folder(run_folder)
    scratch = tempfile.TemporaryDirectory(prefix="femsense-view-")
    try:
        glb = _current_glb(run, Path(scratch.name))
        files: dict[str, Path | bytes] = {**built, "robot.glb": glb, "contacts.json": _json(contacts_of_run(run))}
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


def write_static_page(run_folder: str | Path, out_dir: str | Path, *, page: Path = PAGE) -> Path:
    """Write page, mesh and contacts into a folder that any web server can serve; return the path of its `index.html`.

    `page` is the folder of the built page. Raises as `serve`.
    """
    files = _page_files(page)
    run = _as_run_folder(run_folder)
    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="femsense-view-") as scratch:
        glb = _current_glb(run, Path(scratch))
        for name, source in files.items():
            shutil.copyfile(source, out / name)
        if glb.resolve() != (out / "robot.glb").resolve():
            shutil.copyfile(glb, out / "robot.glb")
    (out / "contacts.json").write_bytes(_json(contacts_of_run(run)))
    return out / "index.html"


def export_run(run_folder: str | Path, path: str | Path, *, bones: int | None = None, color_rgb: Any = None) -> ExportReport:
    """Write the skinned, animated mesh of a run folder (see `gltf.export_states`).

    Raises InputError where `states.npz` is missing, unreadable or lacks a part.
    """
    run = _as_run_folder(run_folder)
    states = _load_states(run)
    return export_states(
        states.get("rest_nodes_m"),
        states["tets"],
        states["time_s"],
        states["nodes_m"],
        path,
        bones=bones,
        color_rgb=color_rgb,
        name=_name_of_run(run),
    )


def contacts_of_run(run_folder: str | Path) -> dict[str, Any]:
    """Return what the page shows beside the mesh, ready for JSON; everything in the robot frame, SI.

    Returns:
        `format`, `name`, `frame` ("robot"), and `frames`: for each state its time from the first [s], the frame's
        number, status and residual where `frames.csv` has them, and the contacts of `contacts.csv`.

    Raises:
        InputError: a column is missing, or a value is not a number.
    """
    run = _as_run_folder(run_folder)
    times = np.atleast_1d(np.asarray(_load_states(run)["time_s"], dtype=np.float64))
    frames: list[dict[str, Any]] = [
        {"time_s": float(t - times[0]), "frame": None, "status": None, "rms_after_m": None, "contacts": []} for t in times
    ]
    for row in _rows(run / "frames.csv", ("frame", "time_s")):
        state = frames[_nearest(times, row.number("time_s"))]
        state.update(frame=row.integer("frame"), status=row.values.get("status") or None, rms_after_m=row.optional("rms_after_m"))
    for row in _rows(run / "contacts.csv", CONTACT_COLUMNS):
        state = frames[_nearest(times, row.number("time_s"))]
        state["frame"] = row.integer("frame") if state["frame"] is None else state["frame"]
        state["contacts"].append(_contact(row))
    return {"format": FORMAT, "name": _name_of_run(run), "frame": "robot", "frames": frames}


# ---- the files of a run --------------------------------------------------------------------------------------------------

CONTACT_COLUMNS = ("frame", "time_s", "contact", "x_m", "y_m", "z_m", "fx_n", "fy_n", "fz_n", "force_n", "std_n", "source")


class _Row:
    """One row of a table, which knows where it stands."""

    def __init__(self, values: dict[str, str], where: str) -> None:
        self.values, self.where = values, where

    def number(self, key: str) -> float:
        value = self.optional(key)
        if value is None:
            raise InputError(
                "a number is missing", where=f"{self.where}, {key}", found=self.values.get(key), expected="a finite number"
            )
        return value

    def optional(self, key: str) -> float | None:
        """Return the number, or None where the cell is empty or says nan."""
        text = (self.values.get(key) or "").strip()
        if not text:
            return None
        try:
            value = float(text)
        except ValueError:
            raise InputError("not a number", where=f"{self.where}, {key}", found=text, expected="a number") from None
        return value if math.isfinite(value) else None

    def integer(self, key: str) -> int:
        return int(self.number(key))

    def vector(self, *keys: str) -> list[float] | None:
        values = [self.optional(k) for k in keys]
        return None if any(v is None for v in values) else [float(v) for v in values if v is not None]


def _contact(row: _Row) -> dict[str, Any]:
    return {
        "contact": row.integer("contact"),
        "point_m": row.vector("x_m", "y_m", "z_m"),
        "force_vector_n": row.vector("fx_n", "fy_n", "fz_n"),
        "force_n": row.optional("force_n"),
        "std_n": row.optional("std_n"),
        "source": row.values.get("source") or "",
    }


def _rows(path: Path, columns: Iterable[str]) -> list[_Row]:
    """Return the rows of a CSV file; none where there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        missing = [c for c in columns if c not in (reader.fieldnames or [])]
        if missing:
            raise InputError(
                "columns are missing", where=path, found=", ".join(reader.fieldnames or []), expected=", ".join(missing)
            )
        return [_Row(row, f"{path}:{i}") for i, row in enumerate(reader, start=2)]


def _nearest(times: FloatArray, time: float) -> int:
    return int(np.abs(times - time).argmin())


def _as_run_folder(folder: str | Path) -> Path:
    run = Path(folder)
    if not (run / "states.npz").is_file():
        raise InputError(
            "not a run: no states.npz",
            where=run,
            expected="a folder that femsense estimate wrote",
            hint="femsense estimate … -o RUN",
        )
    return run


def _load_states(run: Path) -> dict[str, Any]:
    path = run / "states.npz"
    try:
        with np.load(path, allow_pickle=False) as file:
            states = {key: file[key] for key in file.files if key in ("time_s", "nodes_m", "tets", "rest_nodes_m")}
    except Exception as error:  # whatever the archive reader meets in a broken file
        raise InputError("not readable", where=path, found=error, expected="arrays time_s, nodes_m, tets") from None
    missing = [key for key in ("time_s", "nodes_m", "tets") if key not in states]
    if missing:
        raise InputError("arrays are missing", where=path, found=", ".join(states), expected=", ".join(missing))
    return states


def _name_of_run(run: Path) -> str:
    """Return the robot's name where run.json tells it, else the folder's."""
    try:
        known = json.loads((run / "run.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        known = {}
    robot = known.get("robot") if isinstance(known, dict) else None
    name = robot.get("name") if isinstance(robot, dict) else robot
    return Path(name).name if isinstance(name, str) and name else run.resolve().name


def _current_glb(run: Path, scratch: Path) -> Path:
    """Return the mesh of the run, made anew where it is missing or older than the states."""
    glb, states = run / "robot.glb", run / "states.npz"
    if glb.is_file() and glb.stat().st_mtime >= states.stat().st_mtime:
        return glb
    target = glb if os.access(run, os.W_OK) else scratch / "robot.glb"
    export_run(run, target)
    return target


# ---- the page --------------------------------------------------------------------------------------------------------------


def _page_files(page: Path) -> dict[str, Path]:
    """Return the files of a built page by name. Raises MissingDependency."""
    if not (page / "index.html").is_file():
        raise MissingDependency(
            "the viewer page was not built into this installation (its build was skipped, or the sources are used without "
            "installing them)\n  try:      pip install --force-reinstall --no-deps femsense, or in a checkout: pip install -e ."
        )
    return {path.name: path for path in sorted(page.iterdir()) if path.is_file() and not path.name.startswith(".")}


def _json(value: dict[str, Any]) -> bytes:
    return json.dumps(value, allow_nan=False, separators=(",", ":")).encode()


class _Handler(SimpleHTTPRequestHandler):
    """Answers with the files of the page and nothing else of this machine."""

    server: ViewServer

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def _answer(self, *, with_body: bool) -> None:
        name = self.path.split("?", 1)[0].split("#", 1)[0].lstrip("/") or "index.html"
        content = self.server.files.get(name)
        try:
            data = content.read_bytes() if isinstance(content, Path) else content
        except OSError:
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
        """Say nothing: the library does not print."""
