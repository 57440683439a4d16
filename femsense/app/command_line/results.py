"""What shows results: `export`, `view`, `stream`, `report`."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from femsense.app.command_line.answer import Answer, say
from femsense.app.command_line.parameters import Json, RunPath
from femsense.core.errors import InputError

if TYPE_CHECKING:
    from femsense.app.stream_command import LiveStream


def export(
    run: RunPath,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="The file to write: .glb or .usdz.")] = Path(
        "robot.glb"
    ),
    mcap: Annotated[
        Path | None,
        typer.Option("--mcap", metavar="FILE", help="Write messages of ROS 2 for Foxglove instead.", show_default=False),
    ] = None,
    rerun: Annotated[
        Path | None,
        typer.Option("--rerun", metavar="FILE", help="Write a recording for the Rerun viewer instead.", show_default=False),
    ] = None,
    bones: Annotated[
        int | None,
        typer.Option("--bones", min=1, max=255, help="How many bones; chosen by itself if not given.", show_default=False),
    ] = None,
    skin: Annotated[
        Path | None,
        typer.Option("--skin", metavar="FILE", help="A surface of your own: STL, OBJ, PLY or glTF.", show_default=False),
    ] = None,
    skin_unit: Annotated[
        str | None, typer.Option("--skin-unit", metavar="m|cm|mm", help="Of its coordinates.", show_default=False)
    ] = None,
    vertices: Annotated[int, typer.Option("--vertices", min=100, help="Of --skin at most; more are decimated.")] = 100_000,
    arrows: Annotated[bool, typer.Option("--arrows", help="Contact forces too, as arrows that move; in .glb.")] = False,
    json: Json = False,
) -> Answer:
    """Write a run as a skinned, animated mesh (glTF, USDZ)."""
    if mcap is not None:
        from dataclasses import asdict

        from femsense.xr.mcap_export import export_mcap

        written = export_mcap(run, mcap)
        text = f"{written.frames} frames, {written.clouds} clouds, {written.contacts} contacts on {len(written.topics)} topics"
        return Answer({"path": str(mcap), **asdict(written)}, f"{text}\n\nwritten: {mcap}")
    if rerun is not None:
        from dataclasses import asdict

        from femsense.xr.rerun_export import export_rerun

        shown = export_rerun(run, rerun)
        text = f"{shown.frames} frames, {shown.clouds} clouds, {shown.contacts} contacts"
        return Answer({"path": str(rerun), **asdict(shown)}, f"{text}\n\nwritten: {rerun}")
    from femsense.io.files import check_target
    from femsense.xr.export import export_glb
    from femsense.xr.run_contents import skin_for_run

    if skin is not None:
        check_target(output, folder=False, inputs=[skin])
    worn = None if skin is None else skin_for_run(run, skin, unit=skin_unit, budget=vertices)
    report = export_glb(run, output, bones=bones, skin=worn, arrows=arrows)
    document = {name: getattr(report, name) for name in ("bones", "vertices", "frames", "rms_m", "max_m")}
    text = (
        f"{report.frames} frames, {report.bones} bones, {report.vertices} vertices; {1e3 * report.rms_m:.3f} mm rms from the "
        f"finite elements"
    )
    return Answer({"path": str(output), **document}, f"{text}\n\nwritten: {output}")


def view(
    run: Annotated[
        Path | None, typer.Argument(metavar="RUN", help="A folder that femsense estimate wrote.", show_default=False)
    ] = None,
    stream: Annotated[
        str | None,
        typer.Option("--stream", metavar="URL", help="Show what streams there instead: http:// or mqtt://.", show_default=False),
    ] = None,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="0 takes a free one.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the default browser.")] = True,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Write the page for a web server instead.", show_default=False),
    ] = None,
    password_file: Annotated[
        Path | None, typer.Option("--password-file", metavar="FILE", help="Of the stream.", show_default=False)
    ] = None,
    authority: Annotated[
        Path | None, typer.Option("--authority", metavar="PEM", help="Of the stream's certificate.", show_default=False)
    ] = None,
    json: Json = False,
) -> Answer:
    """Show a run or a stream on a page for browsers and headsets."""
    from femsense.app.stream_options import is_encrypted, need_one, need_with

    need_with("--output", output is not None, "RUN", stream is None)
    need_with("--password-file", password_file is not None, "--stream", stream is not None)
    need_with("--authority", authority is not None, "--stream https:// or mqtts://", is_encrypted(stream))
    if stream is not None:
        from femsense.xr.stream.access import without_password

        need_one([] if run is None else [run], stream)
        say(f"connecting to {without_password(stream)}")
        from femsense.app.stream_command import show_stream

        return _live(show_stream(stream, port=port, password_file=password_file, authority=authority), browser)
    if run is None:
        raise InputError("nothing to show", where="femsense view", expected="RUN, or --stream URL")
    say(f"reading {run}")
    from femsense.xr.run_contents import has_current_glb
    from femsense.xr.view import serve, write_static_page

    if (run / "states.npz").is_file() and not has_current_glb(run):
        say(f"making the mesh of {run}")
    if output is not None:
        page = write_static_page(run, output)
        return Answer({"page": str(page)}, f"written: {page}")
    server = serve(run, port=port, open_browser=browser)

    def wait() -> None:
        with contextlib.suppress(KeyboardInterrupt), server:
            server.wait()
        say("the page is closed")

    return Answer({"url": server.url}, f"{server.url}\nCtrl-C ends it", then=wait)


def stream(
    runs: Annotated[list[Path] | None, typer.Argument(metavar="RUN", help="Runs to play.", show_default=False)] = None,
    sensors: Annotated[
        str | None,
        typer.Option(
            "--sensors", metavar="SOURCE", help="CSV file, udp://, mqtt://, serial: – alone, or with --drag.", show_default=False
        ),
    ] = None,
    model: Annotated[
        Path | None, typer.Option("--model", metavar="MODEL", help="Of femsense learn, for --sensors.", show_default=False)
    ] = None,
    drag: Annotated[bool, typer.Option("--drag", help="Let viewers drag the robot of the first run.")] = False,
    commands: Annotated[bool, typer.Option("--commands", help="With --drag: publish commands once a viewer arms them.")] = False,
    host: Annotated[str, typer.Option("--host", help="0.0.0.0 lets other machines watch; needs a password.")] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Of the page and its WebSocket; 0: a free one.")] = 8010,
    mqtt: Annotated[
        str | None,
        typer.Option("--mqtt", metavar="HOST[:PORT]", help="Send to this broker; mqtts:// encrypts.", show_default=False),
    ] = None,
    broker: Annotated[bool, typer.Option("--broker", help="Serve a broker for this machine.")] = False,
    broker_port: Annotated[
        int | None,
        typer.Option(
            "--broker-port", min=0, max=65535, help="Of --broker; 1883 if not given, 0: a free one.", show_default=False
        ),
    ] = None,
    json_mirror: Annotated[bool, typer.Option("--json-mirror", help="Send pose_json too, for Unity's JsonUtility.")] = False,
    rate: Annotated[float, typer.Option("--rate", min=0.1, max=1000.0, help="Most poses a second.")] = 60.0,
    once: Annotated[bool, typer.Option("--once", help="Play once and end.")] = False,
    password_file: Annotated[
        Path | None, typer.Option("--password-file", metavar="FILE", help="Or variable FEMSENSE_PASSWORD.", show_default=False)
    ] = None,
    certificate: Annotated[
        Path | None, typer.Option("--certificate", metavar="PEM", help="Encrypt with this.", show_default=False)
    ] = None,
    key: Annotated[Path | None, typer.Option("--key", metavar="PEM", help="Of the certificate.", show_default=False)] = None,
    authority: Annotated[
        Path | None, typer.Option("--authority", metavar="PEM", help="Of the broker's certificate.", show_default=False)
    ] = None,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the default browser.")] = False,
    json: Json = False,
) -> Answer:
    """Send bone poses and forces over MQTT and WebSocket."""
    from femsense.app.stream_options import is_encrypted, need_model, need_stream, need_with

    need_stream(runs or [], sensors, drag=drag)
    need_model(sensors, model)
    need_with("--commands", commands, "--drag", drag)
    need_with("--drag", drag, "RUN", bool(runs))
    need_with("--once", once, "RUN", bool(runs))
    need_with("--broker-port", broker_port is not None, "--broker", broker)
    need_with("--authority", authority is not None, "--mqtt mqtts://HOST", is_encrypted(mqtt))
    for what in [str(run) for run in runs or []] + ([] if model is None else [str(model)]):
        say(f"reading {what}")
    from femsense.app.stream_command import StreamOptions, let_drag, measure_by_sensors, stream_runs, stream_sensors

    options = StreamOptions(
        host=host,
        port=port,
        mqtt=mqtt,
        broker_port=(1883 if broker_port is None else broker_port) if broker else None,
        json_mirror=json_mirror,
        password_file=password_file,
        certificate=certificate,
        key=key,
        authority=authority,
        rate_hz=rate,
    )
    if sensors is not None and model is not None and not runs:
        return _live(stream_sensors(sensors, model, options, say=say), browser)
    live = stream_runs(runs or [], options, loop=not once, say=say)
    if drag:
        from femsense.xr.stream.command_gate import GateOptions
        from femsense.xr.stream.drag_server import DragOptions

        say("making ready for drags")
        let_drag(live, (runs or [])[0], DragOptions(gate=GateOptions(allowed=commands)))
        if sensors is not None and model is not None:
            measure_by_sensors(live, sensors, model, say)
    return _live(live, browser)


def _live(live: LiveStream, browser: bool) -> Answer:
    """Return the answer that goes on until the stream ends."""
    from femsense.app.stream_command import stream_document, stream_text

    if browser:
        import webbrowser

        webbrowser.open(live.url)

    def wait() -> None:
        with contextlib.suppress(KeyboardInterrupt), live:
            live.wait(say)
        say(live.streamed.text if live.publishers else "the page is closed")

    return Answer(stream_document(live), stream_text(live), then=wait)


def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A folder of results.", show_default=False)],
    json: Json = False,
) -> Answer:
    """Write the figures of results as one HTML file."""
    from femsense.report import write_report

    page = write_report(folder)
    return Answer({"report": str(page)}, f"written: {page}")
