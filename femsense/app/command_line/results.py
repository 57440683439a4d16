"""Commands that show results: `export`, `view`, `stream`, `report`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from femsense.app.command_line.adapter import command
from femsense.app.command_line.answer import Answer, Served, say
from femsense.app.command_line.parameters import RunPath, argument, option, run_of
from femsense.app.command_line.several import Several
from femsense.app.stream_options import StreamOptions, is_encrypted, need_model, need_one, need_stream, need_with
from femsense.core.errors import InputError

if TYPE_CHECKING:
    from femsense.app.stream_command import LiveStream


@command()
def export(
    run: RunPath,
    output: Annotated[Path, option("-o --output", "FILE", "The file to write: .glb or .usdz.")] = Path("robot.glb"),
    mcap: Annotated[Path | None, option("--mcap", "FILE", "Write messages of ROS 2 for Foxglove instead.")] = None,
    rerun: Annotated[Path | None, option("--rerun", "FILE", "Write a recording for the Rerun viewer instead.")] = None,
    bones: Annotated[int | None, option("--bones", help="How many bones; chosen by itself if not given.", min=1, max=255)] = None,
    skin: Annotated[Path | None, option("--skin", "FILE", "A surface of your own: STL, OBJ, PLY or glTF.")] = None,
    skin_unit: Annotated[str | None, option("--skin-unit", "m|cm|mm", "Of its coordinates.")] = None,
    vertices: Annotated[int, option("--vertices", help="Of --skin at most; more are decimated.", min=100)] = 100_000,
    arrows: Annotated[bool, option("--arrows", help="Contact forces too, as arrows that move; in .glb.")] = False,
) -> Answer:
    """Write a run as a skinned, animated mesh (glTF, USDZ)."""
    run = run_of(run)
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


@command()
def view(
    run: Annotated[Path | None, argument("RUN", "A folder that femsense estimate wrote.")] = None,
    stream: Annotated[
        str | None, option("--stream", "URL", "Show the stream at this address instead: http:// or mqtt://.")
    ] = None,
    live: Annotated[Path | None, option("--live", "SESSION", "Show the session that is recorded there now.")] = None,
    port: Annotated[int, option("--port", help="0 takes a free one.", min=0, max=65535)] = 0,
    browser: Annotated[bool, option("--browser/--no-browser", help="Open the default browser.")] = True,
    output: Annotated[Path | None, option("-o --output", "DIR", "Write the page for a web server instead.")] = None,
    password_file: Annotated[Path | None, option("--password-file", "FILE", "Of the stream.")] = None,
    authority: Annotated[Path | None, option("--authority", "PEM", "Of the stream's certificate.")] = None,
) -> Answer:
    """Show a run or a stream on a page for browsers and headsets."""
    if live is not None:
        from femsense.app.live_command import page_of_session

        need_one([] if run is None and stream is None else [live], str(live))
        stream = page_of_session(live)
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
        raise InputError("nothing to show", where="femsense view", expected="RUN, --stream URL or --live SESSION")
    run = run_of(run)
    say(f"reading {run}")
    from femsense.xr.run_contents import has_current_glb
    from femsense.xr.view import serve, write_static_page

    if (run / "states.npz").is_file() and not has_current_glb(run):
        say(f"making the mesh of {run}")
    if output is not None:
        page = write_static_page(run, output)
        return Answer({"page": str(page)}, f"written: {page}")
    server = serve(run, port=port, open_browser=browser)

    def end() -> None:
        server.stop()
        say("the page is closed")

    return Answer({"url": server.url}, f"{server.url}\nCtrl-C ends it", then=Served(server.wait, end))


@command()
def stream(
    options: StreamOptions,
    runs: Annotated[list[Path] | None, argument("RUN", "Runs to play.")] = None,
    sensors: Annotated[
        str | None, option("--sensors", "SOURCE", "CSV file, udp://, mqtt://, serial: – alone, or with --drag.")
    ] = None,
    model: Annotated[Path | None, option("--model", "MODEL", "Of femsense learn, for --sensors.")] = None,
    skin: Annotated[Path | None, option("--skin", "FILE", "With --sensors: the robot's surface, GLB, STL, OBJ, PLY.")] = None,
    skin_unit: Annotated[str | None, option("--skin-unit", "UNIT", "Of its coordinates: m, cm or mm.")] = None,
    drag: Annotated[bool, option("--drag", help="Let viewers drag the robot of the first run.")] = False,
    once: Annotated[bool, option("--once", help="Play once and end.")] = False,
    browser: Annotated[bool, option("--browser/--no-browser", help="Open the default browser.")] = False,
) -> Answer:
    """Send bone poses and forces over MQTT and WebSocket."""
    runs = [run_of(run) for run in runs or []]
    need_stream(runs, sensors, drag=drag)
    need_model(sensors, model)
    need_with("--skin", skin is not None, "--sensors alone", sensors is not None and not runs)
    need_with("--skin-unit", skin_unit is not None, "--skin", skin is not None)
    need_with("--commands", options.commands, "--drag", drag)
    need_with("--insecure", options.insecure, "--commands", options.commands)
    need_with("--drag", drag, "RUN", bool(runs))
    need_with("--once", once, "RUN", bool(runs))
    need_with("--broker-port", options.broker_port is not None, "--broker", options.broker)
    need_with("--authority", options.authority is not None, "--mqtt mqtts://HOST", is_encrypted(options.mqtt))
    for what in [str(run) for run in runs or []] + ([] if model is None else [str(model)]):
        say(f"reading {what}")
    from femsense.app.stream_command import let_drag, measure_by_sensors, stream_runs, stream_sensors

    if sensors is not None and model is not None and not runs:
        from femsense.xr.user_skin import read_skin

        worn = None if skin is None else read_skin(skin, unit=skin_unit)
        return _live(stream_sensors(sensors, model, options, skin=worn, say=say), browser)
    live = stream_runs(runs or [], options, loop=not once, say=say)
    if drag:
        from femsense.xr.stream.command_gate import GateOptions
        from femsense.xr.stream.drag_server import DragOptions

        say("making ready for drags")
        let_drag(live, (runs or [])[0], DragOptions(gate=GateOptions(allowed=options.commands)))
        if sensors is not None and model is not None:
            measure_by_sensors(live, sensors, model, say)
    return _live(live, browser)


def _live(live: LiveStream, browser: bool) -> Answer:
    """Return the answer that goes on until the stream ends."""
    from femsense.app.stream_command import stream_document, stream_text

    if browser:
        import webbrowser

        webbrowser.open(live.url)

    def end() -> None:
        live.close()
        say(live.streamed.text if live.publishers else "the page is closed")

    return Answer(stream_document(live), stream_text(live), then=Served(lambda: live.wait(say), end))


@command(Several.EACH)
def report(
    folders: Annotated[
        list[Path],
        argument("DIR…", "A folder of results; several folders, or one with the results of several jobs, are several jobs."),
    ],
) -> Answer:
    """Write the figures of results as one HTML file."""
    from femsense.report import write_report

    page = write_report(run_of(folders[0]))
    return Answer({"report": str(page)}, f"written: {page}")
