"""`femsense stream` and `femsense view --stream`: servers, brokers and sources put together."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Any

from femsense.app.stream_log import Streamed, StreamLog, Watched, connection, readings_from, remark
from femsense.app.stream_options import StreamOptions
from femsense.core.errors import InputError
from femsense.xr.stream.access import Access, read_password, without_password
from femsense.xr.stream.bridge import Bridge
from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.mqtt import BrokerAddress, EmbeddedBroker, MqttSink, broker_address, lets_anybody_in
from femsense.xr.stream.payloads import Kind, Twin, TwinFrame, measured_bytes, topic
from femsense.xr.stream.publisher import FIRST_POSE, Publisher, PublishOptions, play
from femsense.xr.stream.websocket import ServerOptions, WebSocketServer
from femsense.xr.view import PAGE, live_page_files

if TYPE_CHECKING:
    from femsense.xr.stream.drag_server import DragOptions, DragServer
    from femsense.xr.stream.readings import Readings
    from femsense.xr.user_skin import UserSkin

WATCH_S = 0.05
"""Period at which a source is checked for a stop."""
MEASURED_HZ = 100.0
"""Highest rate at which sensors measure markers: twice the rate of commands."""
PATIENCE_S = 3.0
"""A connection that takes longer than this is reported as missing."""


@dataclass(eq=False, slots=True)
class LiveStream:
    """Streams that run in the background; a context manager."""

    hub: Hub
    server: WebSocketServer
    broker: EmbeddedBroker | None = None
    commands: bool = False
    """Whether commands may go out."""
    publishers: list[Publisher] = field(default_factory=list)
    threads: list[Thread] = field(default_factory=list)
    stop: Event = field(default_factory=Event)
    closers: list[Callable[[], None]] = field(default_factory=list)
    watched: list[Watched] = field(default_factory=list)
    """Connections to elsewhere, and where readings come from."""
    sources: list[Readings] = field(default_factory=list)
    brokers: dict[str, MqttSink] = field(default_factory=dict)
    """Elsewhere, that it is sent to, by address."""
    begun: float = field(default_factory=time.monotonic)

    @property
    def url(self) -> str:
        """Where the page is."""
        return self.server.url

    @property
    def trouble(self) -> str:
        """The missing connections and readings, with reasons; empty where there are none."""
        return "; ".join(one.trouble for one in self.watched if one.trouble)

    @property
    def streamed(self) -> Streamed:
        """The poses streamed so far, and their receivers."""
        poses = {publisher.twin.name: publisher.sent for publisher in self.publishers}
        clients = None if self.broker is None else self.broker.clients
        brokers = {where: sink.was_connected for where, sink in self.brokers.items()}
        passed = sum(readings.passed for readings in self.sources)
        dropped = sum(readings.dropped for readings in self.sources)
        return Streamed(poses, time.monotonic() - self.begun, self.server.visits, clients, brokers, passed, dropped)

    def wait(self, say: Callable[[str], None] | None = None) -> None:
        """Return when all sources have ended; meanwhile report lost and restored connections by say(text)."""
        log, patient = StreamLog(self.watched), time.monotonic() + PATIENCE_S
        while any(thread.is_alive() for thread in self.threads) or not (self.threads or self.stop.is_set()):
            living = [thread for thread in self.threads if thread.is_alive()]
            living[0].join(0.5) if living else self.stop.wait(0.5)
            for text in log.news() if time.monotonic() > patient else ():
                (say or quiet)(text)

    def close(self) -> None:
        """End the sources, publish that, and free the ports."""
        self.stop.set()
        for thread in self.threads:
            thread.join(2.0)
        for publisher in self.publishers:
            publisher.end()
        for closer in self.closers:
            closer()
        self.hub.close()

    def __enter__(self) -> LiveStream:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def quiet(_text: str) -> None:
    """Report nothing."""


def stream_runs(
    runs: Sequence[Path], options: StreamOptions, *, loop: bool = True, say: Callable[[str], None] = quiet
) -> LiveStream:
    """Play runs at their own times to whoever watches; return at once. `say` is called before a long step.

    Raises:
        InputError: a folder without states, or an address that cannot be used.
        MissingDependency: the extra `xr` is not installed, or the page was not built.
    """
    from femsense.xr.run_contents import has_current_glb
    from femsense.xr.stream.run_source import frames_of, open_run

    for run in runs:
        if (run / "states.npz").is_file() and not has_current_glb(run):
            say(f"making the mesh of {run}")
    opened = [open_run(run) for run in runs]
    names = _distinct([one.twin.name for one in opened])
    live = _serve(options, names[0])
    for one, name in zip(opened, names):
        _play(live, replace(one.twin, name=name), frames_of(one, rate_hz=options.rate_hz, loop=loop), options)
        live.closers.append(one.clouds.close)
    return live


def stream_sensors(
    source: str,
    model_file: Path,
    options: StreamOptions,
    *,
    skin: UserSkin | None = None,
    say: Callable[[str], None] = quiet,
) -> LiveStream:
    """Send the poses that a learnt model predicts from sensors while they are read; return at once. `say` is called while it waits for a
    file.

    `skin`: the robot's own surface, in the frame of reference of the model; a tube without it.

    Raises:
        InputError: no model, no such source, or an address that cannot be used.
        MissingDependency: the extra `xr` is not installed, or the page was not built.
    """
    from femsense.xr.proprioception.model_file import load_model
    from femsense.xr.stream.readings import readings_of
    from femsense.xr.stream.sensor_source import frames_of_sensors, sensor_twin

    model = load_model(model_file)
    twin = sensor_twin(model, model_file.stem, skin)
    stop = Event()
    readings = readings_of(source, model.channels, stop)  # opened before anything is served, so that errors are reported at once
    live = _serve(options, twin.name, stop)
    shown = without_password(source)
    say_of_file(readings, source, say)
    publisher = _play(live, twin, frames_of_sensors(readings, model), options, readings=f"readings of {shown}")
    _watch(live, readings, shown, lambda: readings.trouble or publisher.trouble)
    return live


def let_drag(live: LiveStream, run: Path, options: DragOptions) -> DragServer:
    """Let viewers drag the robot of a run that streams; the first that `live` plays. Its calibration's initial inputs are subtracted from commands.

    Raises InputError if commands are allowed but `StreamOptions.commands` is not set: the access control of brokers was not checked then.
    """
    if options.gate.allowed and not live.commands:
        raise InputError("this stream sends no commands", where="options.gate", expected="StreamOptions(commands=True)")
    from femsense.calib.files import read_calibration
    from femsense.sensing.run_files import read_run
    from femsense.xr.glb_reader import read_glb
    from femsense.xr.stream.drag_server import DragServer, handles_of

    publisher = live.publishers[0]
    robot = read_run(run).robot
    skin = read_glb(publisher.twin.glb).skin
    known = read_calibration(run) if (run / "calibration.json").is_file() else None
    server = DragServer(live.hub, robot, skin, name=publisher.twin.name, calibration=known, options=options)
    publisher.announce(replace(publisher.twin, handles=handles_of(robot), commands=options.gate.allowed))
    live.closers.append(server.close)
    return server


def measure_by_sensors(live: LiveStream, source: str, model_file: Path, say: Callable[[str], None] = quiet) -> None:
    """Publish on `measured` the positions that sensors predict for the markers of the first robot that `live` plays.

    This closes the loop of a drag (see `let_drag`, which comes before).

    Raises:
        InputError: no model, no such source, or a model of markers that the robot does not have, or not in its frame.
    """
    from femsense.xr.proprioception.labelled import ROBOT, WORDS
    from femsense.xr.proprioception.model_file import load_model
    from femsense.xr.stream.readings import readings_of
    from femsense.xr.stream.sensor_source import markers_of_sensors

    model, twin = load_model(model_file), live.publishers[0].twin
    known = [handle.name for handle in twin.handles]
    unknown = [name for name in model.marker_names if name not in known]
    if unknown:
        raise InputError(
            "the model has markers that the robot does not have: is it another robot's?",
            where=str(model_file),
            found=", ".join(unknown),
            expected=f"markers of {twin.name}: {', '.join(known)}",
            hint="learn from columns that are named as the markers in robot.toml",
        )
    if model.frame != ROBOT:
        raise InputError(
            "the model's markers are not in the robot's frame",
            where=str(model_file),
            found=WORDS[model.frame],
            expected=WORDS[ROBOT],
            hint="learn with -c CALIBRATION, or with --robot-frame where they are in it",
        )
    readings, shown = readings_of(source, model.channels, live.stop), without_password(source)
    say_of_file(readings, source, say)
    _watch(live, readings, shown, lambda: readings.trouble)

    def run() -> None:
        for seq, (time_s, markers, why) in enumerate(markers_of_sensors(readings, model)):
            message = Message(topic(twin.name, Kind.MEASURED), measured_bytes(seq, time_s, markers, why))
            live.hub.publish([message])
            live.hub.received(message, "sensors")
            live.stop.wait(1.0 / MEASURED_HZ)

    thread = Thread(target=run, daemon=True, name="femsense-measured")
    live.closers.append(lambda: thread.join(2.0))
    thread.start()


def show_stream(
    url: str, *, port: int = 0, page: Path = PAGE, password_file: Path | None = None, authority: Path | None = None
) -> LiveStream:
    """Serve the page on this machine for the stream at a URL; return at once. Raises as `Bridge` and `WebSocketServer`."""
    files = live_page_files(page)
    hub = Hub()
    bridge = Bridge(hub, url, password=read_password(password_file), authority=authority)
    try:
        server = WebSocketServer(hub, files, options=ServerOptions(port=port))
    except BaseException:
        bridge.close()
        raise
    watched = connection(without_password(url), lambda: bridge.trouble)
    server.trouble = lambda: watched.trouble
    return LiveStream(hub, server, closers=[bridge.close], watched=[watched])


def stream_document(live: LiveStream) -> dict[str, Any]:
    """Return addresses, robots and topics, for `--json`."""
    return {
        "url": live.url,
        "robots": [publisher.twin.name for publisher in live.publishers],
        "topics": [topic(publisher.twin.name, "#") for publisher in live.publishers],
        "broker_port": None if live.broker is None else live.broker.port,
    }


def stream_text(live: LiveStream) -> str:
    """Return the same for people."""
    lines = [live.url]
    if live.broker is not None:
        lines.append(f"MQTT: 127.0.0.1, port {live.broker.port}")
    lines += [f"topics: {topic(publisher.twin.name, '…')}" for publisher in live.publishers]
    if live.server.access.password and live.server.access.certificate is None:
        lines.append("the password of the page travels unencrypted: --certificate and --key encrypt")
    return "\n".join([*lines, "Ctrl-C ends it"])


def say_of_file(readings: Readings, source: str, say: Callable[[str], None]) -> None:
    """Report at once that a file is waited for; connections are given some time first."""
    if "://" not in source and readings.away:
        say(f"waiting for {source}: {readings.away}")


def _distinct(names: Sequence[str]) -> list[str]:
    """Number repeated names."""
    found: list[str] = []
    for name in names:
        number, chosen = 1, name
        while topic(chosen, "") in {topic(other, "") for other in found}:
            number += 1
            chosen = f"{name}-{number}"
        found.append(chosen)
    return found


def _serve(options: StreamOptions, first: str, stop: Event | None = None) -> LiveStream:
    """Start the server, and a broker or a client of one where the options name it; `stop` ends the sources."""
    password = read_password(options.password_file)
    access = Access(options.host, password, options.certificate, options.key, tuple(options.names))
    address = None if options.mqtt is None else broker_address(options.mqtt, password=password, authority=options.authority)
    if options.commands and not options.insecure:
        _need_known_clients(address, embedded=options.served_port is not None, password=password)
    hub = Hub()
    with contextlib.ExitStack() as undo:
        files = live_page_files(options.page or PAGE)
        server = WebSocketServer(hub, files, access=access, options=ServerOptions(port=options.port))
        undo.callback(hub.close)
        broker = None if options.served_port is None else EmbeddedBroker(hub, port=options.served_port, access=access)
        live = LiveStream(hub, server, broker, options.commands, stop=stop or Event())
        if address is not None:
            sink = MqttSink(hub, address, first)
            where = f"{address.host}:{address.port}"
            live.brokers[where] = sink
            live.watched.append(connection(where, lambda: sink.trouble))
        undo.pop_all()
    return live


def _need_known_clients(address: BrokerAddress | None, *, embedded: bool, password: str | None) -> None:
    """Raise InputError where a broker lets anybody in: whoever reaches it could move the robot."""
    where = "--commands"
    hint = "--insecure sends commands nevertheless: whoever reaches the broker can then move the robot"
    if embedded and not password:
        raise InputError(
            "the broker of --broker lets anybody in", where=where, expected="a password: --password-file FILE", hint=hint
        )
    if address is None or (known := lets_anybody_in(address)) is False:
        return
    found = "it lets anybody in" if known else "it does not answer, so that it cannot be known whom it lets in"
    if address.user is None:
        found = "without a name and password it lets anybody in"
    raise InputError(
        "commands need a broker that asks for a password",
        where=where,
        found=f"{address.host}:{address.port}: {found}",
        expected="allow_anonymous false there, and mqtts://USER@HOST with --password-file FILE",
        hint=hint,
    )


def _watch(live: LiveStream, readings: Readings, shown: str, why: Callable[[], str]) -> None:
    """Report missing readings, and lines that are no readings."""
    live.sources.append(readings)
    live.watched += [readings_from(shown, why, lambda: readings.refused), remark(lambda: readings.assumed)]


def _play(live: LiveStream, twin: Twin, frames: Iterator[TwinFrame], options: StreamOptions, *, readings: str = "") -> Publisher:
    """Send frames from a thread of their own; those of `readings` at once as they come, others at their own times."""
    publishing = PublishOptions(rate_hz=options.rate_hz, json_mirror=options.json_mirror, waits_for=readings or FIRST_POSE)
    publisher = Publisher(live.hub, twin, publishing)
    live.publishers.append(publisher)

    def watch() -> None:
        while thread.is_alive() and not live.stop.wait(WATCH_S):
            publisher.watch()

    def run() -> None:
        try:
            if readings:
                while (frame := next(frames, None)) is not None:
                    publisher.publish(frame)
                    live.stop.wait(publisher.wait_s())  # and only then is the newest reading taken
            else:
                play(publisher, frames, live.stop)
        finally:
            publisher.end()

    thread = Thread(target=run, daemon=True, name=f"femsense-{twin.name}")
    live.threads.append(thread)
    thread.start()
    if readings:
        Thread(target=watch, daemon=True, name=f"femsense-watch-{twin.name}").start()
    return publisher
