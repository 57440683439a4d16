"""First commands: `demo`, `inspect`, `docs`, `doctor`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from femsense.app.command_line.adapter import command
from femsense.app.command_line.answer import Answer, progress_bar, say
from femsense.app.command_line.parameters import argument, option


@command()
def demo(
    output: Annotated[Path, option("-o --output", "DIR", "Where the results go.")] = Path("femsense-demo"),
) -> Answer:
    """Run the whole chain on a recording of the package."""
    from femsense.app.demo.demo import demo_text, run_demo

    with progress_bar("demo") as progress:
        document = run_demo(output, say=say, progress=progress)
    return Answer(document, demo_text(document))


@command()
def inspect(
    path: Annotated[str, argument("PATH", "A file, a folder, or the name of a robot.")],
    accuracy: Annotated[bool, option("--accuracy", help="Of a robot: its discretisation error in motion and in force.")] = False,
    robot: Annotated[str | None, option("--robot", "ROBOT", "Compare a recording with this robot.")] = None,
) -> Answer:
    """Describe and check a file or folder."""
    from femsense.app.inspect import describe, inspect_accuracy, inspect_path

    if accuracy:
        from femsense.app.accuracy.assess import expected_duration

        say(expected_duration())
        with progress_bar("accuracy") as progress:
            report = inspect_accuracy(path, progress=progress)
    else:
        if robot is not None:
            say("comparing with the robot, and finding the camera's pose to state the forces that it resolves")
        report = inspect_path(path, robot=robot)
    return Answer(report, describe(report), exit_status=2 if report["problems"] else 0)


@command()
def docs(
    page: Annotated[str | None, argument("PAGE", "Such as statuses or effects/creep; by default the home page.")] = None,
    browser: Annotated[bool, option("--browser/--no-browser", help="Open the default browser.")] = True,
) -> Answer:
    """Open the documentation of this version, offline."""
    from femsense.app.site import find_page, site_folder

    address = find_page(site_folder(), page).resolve().as_uri()
    if browser:
        import webbrowser

        webbrowser.open(address)
    return Answer({"page": address}, address)


@command()
def doctor() -> Answer:
    """Check the installation, and list the cameras."""
    from femsense.app.doctor import diagnose, doctor_text
    from femsense.app.doctor_cameras import camera_checks

    document = diagnose()
    document["checks"] += camera_checks()
    return Answer(document, doctor_text(document), exit_status=0 if document["ok"] else 2)
