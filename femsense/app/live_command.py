"""`femsense live`: camera, session, page, brokers and terminal put together."""

from __future__ import annotations

import contextlib
import json
import socket
import subprocess
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from threading import Event, Thread
from typing import Any
from urllib.parse import urlsplit

from femsense.app.live_options import LiveOptions
from femsense.core.errors import InputError
from femsense.io.files import write_json
from femsense.io.robot_toml import load_robot
from femsense.live.actuation import ActuationLimits, make_actuation
from femsense.live.dashboard import shown
from femsense.live.events import Notice
from femsense.live.feed import CameraFeed, FeedOptions
from femsense.live.frames import StampedFrame
from femsense.live.growing import make_scratch, remove_scratch
from femsense.live.keeper import start_keeper
from femsense.live.link import LinkState
from femsense.live.mcap_sink import McapSink
from femsense.live.outlet import Outlet, event_document, live_document
from femsense.live.recorder import DESCRIPTION, LIVE, check_session
from femsense.live.session import Session, SessionOptions
from femsense.model.linear_elements import warn_of_linear_elements
from femsense.xr.stream.access import Access, read_password
from femsense.xr.stream.hub import Hub
from femsense.xr.stream.mqtt import EmbeddedBroker, MqttSink, broker_address
from femsense.xr.stream.websocket import ServerOptions, WebSocketServer
from femsense.xr.view import PAGE, live_page_files

TELL_S = 0.2
"""Period at which the state of the session is sent."""
KEEPER_S = 10.0
RUNNING_S = 10.0
"""A session whose last frame is older than this has ended."""
REACHED_S = 1.0
"""Time within which the page of a running session accepts a connection."""


def sense_live(
    robot: str | Path,
    camera: str,
    options: LiveOptions,
    *,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Run a session until the camera ends, a person ends it, or its time is over; return its figures.

    Arguments:
        robot: folder or name.
        camera: source of frames.
        options: everything else.
        say: called with lines for people.

    Raises:
        FemsenseError: bad input, a source that cannot be used, no calibration that suffices.
    """
    folder = options.output
    if folder is not None:
        check_session(folder)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of single frames; important ones are notices
        body = load_robot(robot)
    warn_of_linear_elements(body.body, where=body.name)
    actuation = (
        None if options.actuation is None else make_actuation(options.actuation, body, ActuationLimits(delay_s=options.delay_s))
    )
    scratch = make_scratch()
    keeper = start_keeper(scratch, None if folder is None else folder.absolute())
    with contextlib.ExitStack() as undo:
        undo.callback(_wait_for, keeper)
        undo.callback(lambda: keeper.stdin and keeper.stdin.close())
        undo.callback(remove_scratch, scratch)
        holder: list[Session] = []

        def skipped(frame: StampedFrame) -> None:
            for session in holder:
                session.skipped(frame)

        hub = Hub()
        undo.callback(hub.close)
        url, brokers = _serve(hub, body.name, options)
        outlet = Outlet(hub, body) if url or brokers or options.mcap else None
        reading = FeedOptions(as_fast_as_possible=options.as_fast_as_possible, ring=scratch.name)
        feed = undo.enter_context(CameraFeed(camera, reading, on_skipped=skipped))
        session = Session(
            body,
            feed,
            scratch,
            actuation=actuation,
            options=SessionOptions(options.calibration, folder, options.inputs, options.zero, options.contact_free),
            on_answer=outlet.show if outlet is not None else lambda _answer, _taken: None,
        )
        holder.append(session)
        undo.callback(session.close)
        stop = Event()
        undo.callback(stop.set)
        Thread(target=_tell, args=(session, outlet, brokers, options.seconds, stop, url), daemon=True).start()
        keys = {"t": session.tare, "T": lambda: session.tare(anyway=True), "c": session.accept_fixed, "q": session.stop}
        with contextlib.suppress(KeyboardInterrupt):  # from the address on, Ctrl-C is the normal end
            if url:
                say(url)
            with shown(session.snapshot, lambda key: keys[key](), say, url):
                session.run()
        session.close()
        stop.set()
        if outlet is not None:
            outlet.end()
        return _summary(session)


def _wait_for(keeper: subprocess.Popen[bytes]) -> None:
    """Wait for the keeper to tidy up; one that takes long continues by itself."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        keeper.wait(KEEPER_S)


def page_of_session(folder: Path) -> str:
    """Return the address of the page of a running session. Raises InputError where none runs."""
    if not (folder / DESCRIPTION).is_file():
        raise InputError(
            "no session runs there",
            where=folder,
            found=f"no {DESCRIPTION}: it is written with the first frame",
            expected="the folder of a running `femsense live … -o SESSION`",
        )
    file = folder / LIVE
    url = json.loads(file.read_text(encoding="utf-8"))["url"] if file.is_file() else ""
    if url and _is_reached(url):
        return str(url)
    rows = [table for place in ("", "skipped/", "tare-*/") for table in folder.glob(f"{place}frames.csv")]
    last = max(table.stat().st_mtime for table in (folder / DESCRIPTION, *rows))
    ago = time.time() - last
    raise InputError(
        "the session has ended, or has no page (--no-page)" if ago < RUNNING_S else "the session has ended",
        where=folder,
        found=f"its last frame at {time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(last))}, {_ago_text(ago)} ago",
        expected="a session that runs",
        hint=f"femsense view {folder} shows what was recorded",
    )


def _is_reached(url: str) -> bool:
    """Return whether a server answers at an address."""
    place = urlsplit(url)
    try:
        socket.create_connection((place.hostname or "127.0.0.1", place.port or 80), REACHED_S).close()
    except OSError:
        return False
    return True


def _ago_text(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.0f} h"


def summary_text(document: dict[str, Any]) -> str:
    """Return the figures of a session for people."""
    d = document
    received, used = d["frames_received"], d["frames_used"]
    lines = [f"{used} of {received} received frames sensed, {d['frames_skipped']} skipped"]
    if d["frames_missed"]:
        lines.append(f"{d['frames_missed']} frames missed: this machine was too busy to receive them")
    if d["frames_dropped"]:
        lines.append(f"{d['frames_dropped']} frames not delivered by the device or its link")
    if "latency_p50_s" in d:
        p50, p95, p99 = (1e3 * d[f"latency_{name}_s"] for name in ("p50", "p95", "p99"))
        lines.append(f"latency {p50:.0f} / {p95:.0f} / {p99:.0f} ms (p50 / p95 / p99 of the last seconds)")
    for event in d["events"]:
        if event["kind"] == LinkState.WARMING_UP.value:
            continue
        often = f"{event['count']} times, last " if event["count"] > 1 else ""
        lasted = f" for {event['duration_s']:.1f} s" if event["duration_s"] else ""
        lines.append(f"{event['kind']} ({often}at {event['time_s']:.1f} s{lasted}): {event['text']}")
    if not used:
        lines.append(f"ended before anything was sensed: {d['todo'] or 'no frame came'}")
    if d["recording"] and received:
        look = "view" if used else "inspect"
        parts = [d["recording"], *d["parts"]]
        lines += ["", *(f"recorded: {part}" for part in parts), *(f"look at it: femsense {look} {part}" for part in parts)]
    return "\n".join(lines)


def _serve(hub: Hub, name: str, options: LiveOptions) -> tuple[str, list[MqttSink]]:
    """Attach page, brokers and file to a hub; return the address of the page, or "", and clients of brokers elsewhere."""
    password = read_password(options.password_file)
    access, url, brokers = Access(options.host, password), "", []
    if options.page:
        url = WebSocketServer(hub, live_page_files(PAGE), access=access, options=ServerOptions(port=options.port)).url
    if options.broker_port is not None:
        EmbeddedBroker(hub, port=options.broker_port, access=access)
    if options.mqtt is not None:
        brokers.append(MqttSink(hub, broker_address(options.mqtt, password=password), name))
    if options.mcap is not None:
        hub.attach(McapSink(options.mcap))
    return url, brokers


def _tell(session: Session, outlet: Outlet | None, brokers: list[MqttSink], seconds: float | None, stop: Event, url: str) -> None:
    """Send the state of the session again and again, watch brokers, and end the session in time."""
    end = time.monotonic() + (float("inf") if seconds is None else seconds)
    folder, is_told = session.options.folder, False
    while not stop.wait(TELL_S):
        session.watch()
        for broker in brokers:
            session.log.lasts(Notice.BROKER_AWAY, broker.trouble)
        if folder is not None and url and not is_told and (folder / DESCRIPTION).is_file():
            write_json(folder / LIVE, {"url": url})  # removed by the keeper
            is_told = True
        if outlet is not None:
            outlet.tell(session.snapshot(), time.monotonic())
        if time.monotonic() > end:
            session.stop()


def _summary(session: Session) -> dict[str, Any]:
    """Return the state of a session at its end, with all its events instead of the last ones."""
    now, begun_s = time.monotonic(), session.log.begun_s
    return live_document(session.snapshot(), now) | {
        "events": [event_document(event, begun_s, now) for event in session.log.totals()]
    }
