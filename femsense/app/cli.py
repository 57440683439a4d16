"""The command line: its commands (`command_line/`, each a few lines around one function of the library), and how they are run.

A command returns an `Answer`; `run` prints it, as text or as JSON, turns errors into one clear message each, and returns the
exit status: 0 done, 1 the data do not allow a result, 2 wrong usage or bad input, 130 stopped. Everything heavy is imported
inside the commands, so that `femsense --help` is quick.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import warnings
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from typer.exceptions import TyperException

import femsense
from femsense.app.command_line import data, learning, loop, results, sensing, start
from femsense.app.command_line.adapter import Command
from femsense.app.command_line.answer import Answer, say
from femsense.app.command_line.parameters import repeat_options
from femsense.app.compiling import announced_compiling
from femsense.core.errors import FemsenseError
from femsense.core.text import one_line, with_type

if TYPE_CHECKING:
    from femsense.many.jobs import Job
    from femsense.many.outcome import Outcome
    from femsense.many.work import Result

STOPPED = 130
"""Exit status after Ctrl-C, as shells have it."""
STOPPED_TEXT = "stopped without half-written files; the same command continues"
STOPPED_EARLY = "stopped before anything was served"
SERVING = ("stream", "view")
"""Commands that end with Ctrl-C; before they serve, they were stopped."""


app = typer.Typer(
    name="femsense",
    help="An ordinary depth camera as a force sensor for soft robots.",
    epilog="Start with: femsense demo. Documentation: femsense docs. Each command takes --help and --json.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"femsense {femsense.__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")] = False,
) -> None: ...


COMMANDS: dict[str, tuple[Command, str]] = {
    "demo": (start.demo, "femsense demo -o femsense-demo"),
    "inspect": (start.inspect, "femsense inspect finger"),
    "import": (data.import_, "femsense import take.db3 -o my-recording --free 0:20"),
    "mesh": (data.mesh, "femsense mesh finger.stl --unit mm -o my-robot"),
    "simulate": (data.simulate, "femsense simulate my-robot script.toml -o my-recording"),
    "calibrate": (sensing.calibrate, "femsense calibrate my-robot my-recording -o calibration.json"),
    "estimate": (sensing.estimate, "femsense estimate my-robot my-recording -c calibration.json -o run"),
    "live": (sensing.live, "femsense live my-robot --camera realsense --actuation fixed:top=2"),
    "improve": (loop.improve, "femsense improve my-robot monday --validation tuesday -o improved"),
    "export": (results.export, "femsense export femsense-demo/run -o robot.glb --arrows"),
    "reach": (sensing.reach, "femsense reach four-leg --target tip=0.01,0,0.12 -o motion.json"),
    "learn": (learning.learn, "femsense learn sensors.csv markers.csv -o finger.onnx"),
    "view": (results.view, "femsense view femsense-demo/run"),
    "stream": (results.stream, "femsense stream --sensors sensors.csv --model finger.onnx --browser"),
    "report": (results.report, "femsense report femsense-demo"),
    "docs": (start.docs, "femsense docs is-this-force-real"),
    "doctor": (start.doctor, "femsense doctor"),
}
"""Name → command, and the last line of its help. In the order of the help."""
for _name, (_command, _example) in COMMANDS.items():
    app.command(_name, epilog=f"\b\nExample:\n  {_example}")(_command)


# Running them


def main() -> NoReturn:
    """Run the command of `sys.argv` and exit with its status."""
    signal.signal(signal.SIGTERM, _stop)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is loaded; why: `femsense.core.parallel.one_blas_thread`
    sys.exit(run(sys.argv[1:]))


def run(arguments: Sequence[str], *, program: typer.Typer = app) -> int:
    """Run a command of a program, print its answer or its error, and return the exit status."""
    notes: list[str] = []
    as_json = "--json" in arguments
    words = repeat_options(list(arguments)) or ["--help"]
    stopped = STOPPED_EARLY if words[0] in SERVING else STOPPED_TEXT
    with _calm_warnings(notes, as_json):
        try:
            with announced_compiling(words, say):
                with _clean_stdout(as_json):
                    answer = program(args=words, prog_name="femsense", standalone_mode=False)
                    if isinstance(answer, Answer) and answer.many is not None:
                        from femsense.app.many_command import run_many

                        answer = run_many(answer.many, run_job, say=say)
                if isinstance(answer, Answer):
                    return _print(answer, as_json, notes)
            return _fail(stopped, STOPPED, as_json, notes) if answer == STOPPED else int(answer or 0)
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            return 1
        except (KeyboardInterrupt, typer.Abort):
            return _fail(stopped, STOPPED, as_json, notes)
        except Exception as error:
            if os.environ.get("FEMSENSE_DEBUG") == "1":
                raise
            return _fail(*_explained(error), as_json, notes)


def run_job(job: Job, *, memory_bytes: int | None, in_process: bool) -> Outcome:
    """Run one of many jobs, in a worker."""
    from femsense.many.work import work_on

    return work_on(job, _result, memory_bytes=memory_bytes, in_process=in_process)


def _result(words: Sequence[str]) -> Result:
    """Run the words of a job. Raises FemsenseError; MemoryError; InputError for wrong usage and for internal errors."""
    from femsense.app.many_command import row_of
    from femsense.core.errors import InputError
    from femsense.many.work import Result

    notes: list[str] = []
    with _calm_warnings(notes, True):
        try:
            answer = app(args=repeat_options(list(words)), prog_name="femsense", standalone_mode=False)
        except (FemsenseError, MemoryError):
            raise
        except Exception as error:
            raise InputError(_explained(error)[0]) from error
    row = {**row_of(words[0], answer.document), "warnings": len(notes) or None}
    return Result(row, answer.text if answer.exit_status else "")


def _print(answer: Answer, as_json: bool, notes: list[str]) -> int:
    if as_json:
        from femsense.io.files import json_text

        document = answer.document if "warnings" in answer.document else {**answer.document, "warnings": notes}
        text = json_text(document)
    else:
        text = answer.text
    if answer.then is None:
        typer.echo(text)
        return answer.exit_status
    # Whoever reads the address may end the command at once, before it waits: that is its normal end, too.
    try:
        with contextlib.suppress(KeyboardInterrupt):
            typer.echo(text)
            sys.stdout.flush()
            answer.then.wait()
    finally:
        answer.then.end()
    return answer.exit_status


def _fail(text: str, status: int, as_json: bool, notes: list[str]) -> int:
    if as_json:
        import json

        typer.echo(json.dumps({"error": text, "exit_status": status, "warnings": notes}, indent=2, ensure_ascii=False))
    typer.echo(f"femsense: {text}", err=True)
    return status


def _backslash_hint(error: FemsenseError) -> str:
    """Return a hint for a missing file that was named with another system's backslashes; "" for all else."""
    where = str(getattr(error, "where", None) or "")
    if os.sep == "\\" or "\\" not in where or os.path.lexists(where):
        return ""
    meant = where.replace("\\", "/")
    known = f"did you mean {meant!r}? " if os.path.lexists(meant) else ""
    return f"\n  try:      {known}Between folders stands / here; a backslash is a part of a name"


def _explained(error: Exception) -> tuple[str, int]:
    """Return a message and the exit status of an error."""
    if isinstance(error, FemsenseError):
        return str(error) + _backslash_hint(error), error.exit_status
    if isinstance(error, TyperException):
        context = getattr(error, "ctx", None)
        command = context.command_path if context is not None else "femsense"
        message = one_line(error.format_message()).replace("Value error, ", "").rstrip(".")
        return f"{message}{'' if message.endswith('?') else '.'} See: {command} --help", 2
    if isinstance(error, ImportError) and not (error.name or "").startswith("femsense"):
        return (
            f"a part of the installation does not load: {one_line(error)}. femsense doctor lists what is missing",
            2,
        )
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror}", 2
    return f"internal error: {with_type(error)}; the details are in {_write_details(error)} (please report it)", 2


def _write_details(error: Exception) -> str:
    import tempfile
    import traceback

    head = f"femsense {femsense.__version__}, Python {sys.version}\narguments: {sys.argv[1:]}\n\n"
    with tempfile.NamedTemporaryFile("w", prefix="femsense-error-", suffix=".txt", delete=False, encoding="utf-8") as stream:
        stream.write(head + "".join(traceback.format_exception(error)))
    return stream.name


@contextlib.contextmanager
def _calm_warnings(notes: list[str], as_json: bool) -> Iterator[None]:
    """Show each warning once, in one line on standard error; keep it for the JSON object too."""

    def show(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        text = one_line(message)
        if text not in notes:
            notes.append(text)
            typer.echo(f"warning: {text}", err=True)

    with warnings.catch_warnings():
        if os.environ.get("FEMSENSE_DEBUG") != "1":
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = show
        yield


@contextlib.contextmanager
def _clean_stdout(active: bool) -> Iterator[None]:
    """While active, whatever a library prints, in Python or in C, goes to standard error."""
    if not active:
        yield
        return
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        _flush_c()
        os.dup2(kept, 1)
        os.close(kept)


def _flush_c() -> None:
    """Flush the buffers of C libraries."""
    import ctypes

    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).fflush(None)


def _stop(*_: object) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    main()
