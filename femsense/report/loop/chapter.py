"""The report on a closed loop: what the model lacked, how well the data say so, and what they cannot say."""

from __future__ import annotations

from pathlib import Path

from femsense.io.robot_toml import load_robot
from femsense.loop.files import LOOP_FORMAT
from femsense.report import words
from femsense.report.documents import read_document
from femsense.report.drawing import skin
from femsense.report.loop.calibration_moves import calibration_table
from femsense.report.loop.data_card import data_card
from femsense.report.loop.document import Loop
from femsense.report.loop.effects import along_table, effects_table, ranking_table, refits_table
from femsense.report.loop.evidence import Evidence
from femsense.report.loop.forces import forces_part
from femsense.report.loop.held_out import held_out_errors
from femsense.report.loop.open_questions import open_questions
from femsense.report.loop.residual_against import covariate_table, residual_against
from femsense.report.loop.residual_at_rest import mean_residual_panels
from femsense.report.loop.residual_in_frames import frame_residuals_panel
from femsense.report.loop.smallest_effects import power_table
from femsense.report.loop.text import correction_text
from femsense.report.loop.what_is_left import tests_table, what_is_left
from femsense.report.page import Chapter, Html, paragraph, section, tiles, together

OLDER = (
    "This loop.json holds no figures of the residual, of calibration, of confounding and of forces: it was written by an "
    "earlier femsense. "
    "Run femsense improve again for the whole report."
)
CLOUDS = (
    "There were no markers: what was fitted are clouds. Each “surface …” is a point of the body's surface; its residual "
    "is how far the "
    "measured surface lies from the model's there, along the normal, outwards positive. Errors are root mean squares of "
    "these distances."
)


def loop_chapter(file: Path, title: str) -> Chapter:
    """Return the report on a loop.

    Arguments:
        file: loop.json; the improved robot beside it is drawn if it is there.
        title: of the chapter.

    Raises:
        InputError: either is broken.
    """
    loop = read_document(file, Loop, LOOP_FORMAT)
    evidence = loop.evidence or Evidence()
    robot = load_robot(file.parent, effects=False) if (file.parent / "robot.toml").is_file() else None
    rest = None if robot is None else skin(robot.body.mesh.nodes, robot.body.mesh.tets)
    body = together(
        _summary(loop),
        None if loop.evidence or not _is_old(loop) else paragraph(OLDER, class_="next"),
        None if has_markers(loop) else paragraph(CLOUDS, class_="soft"),
        section(
            "1. Residual on the robot",
            mean_residual_panels(loop, robot, rest),
            frame_residuals_panel(evidence.pictures, rest),
        ),
        section(
            "2. What the residual goes with",
            residual_against(evidence.frames, evidence.score, evidence.tip),
            covariate_table(evidence.score),
        ),
        section("3. Error on held-out data", held_out_errors(loop.residuals.known(), evidence.frames, loop.noise_m)),
        section(
            "4. Effects",
            effects_table(loop.effects),
            along_table(loop.fitted_along),
            ranking_table(loop.candidates, evidence.ranking, loop.effects),
            refits_table(loop.candidates),
        ),
        section("5. What these data cannot say", open_questions(loop, evidence)),
        section("6. What calibration had taken up", calibration_table(evidence.calibration)),
        section("7. Tests, and what is left", tests_table(evidence.tests), what_is_left(loop, evidence, rest)),
        section("8. Smallest effects that would have been seen", power_table(loop, evidence)),
        section("9. Data", data_card(loop)),
        section("10. What it means for forces", forces_part(evidence.forces)),
    )
    return Chapter(
        title, body, loop.sentence or words.sentence(words.VERDICTS.get(loop.verdict, "")), loop.inputs.robot.name or ""
    )


def _is_old(loop: Loop) -> bool:
    """Return whether more than a verdict is there, so that the figures are missed."""
    return bool(loop.residuals.frame or loop.candidates)


def _summary(loop: Loop) -> Html | None:
    before, after, marked = loop.before, loop.after, has_markers(loop)
    kind = "rms, 3-D" if marked else "rms along the normals"
    items = [
        (title, words.length(errors.validation_rms_m), note)
        for title, errors in (("Held-out error, before", before), ("Held-out error, after", after))
        for note in [f"95 % interval {words.interval(errors.validation_ci_m)}, {kind}" if errors.validation_ci_m else kind]
        if errors != type(errors)()
    ]
    if marked and words.known(before.validation_normal_rms_m) and words.known(after.validation_normal_rms_m):
        ends = f"{words.length(before.validation_normal_rms_m)} → {words.length(after.validation_normal_rms_m)}"
        items.append(("Held-out error of the clouds", ends, "rms along the normals"))
    own = loop.model_error
    if words.known(loop.noise_m):
        source = own.noise_source or "from the data"
        items.append(("Noise of a marker" if marked else "Noise of a cloud", words.length(loop.noise_m), f"{kind}, {source}"))
    if words.known(own.held_out_m):
        note = f"{kind}, held out, beyond noise and discretisation; {words.length(own.fitted_m)} where fitted"
        items.append(("Error of the model", words.length(own.held_out_m), note))
    if loop.correction is not None and words.known(loop.correction.validation_rms_after_m):
        items.append(
            (
                "With an empirical correction",
                words.length(loop.correction.validation_rms_after_m),
                correction_text(loop.correction),
            )
        )
    share = recovered(before.validation_rms_m, after.validation_rms_m, loop.noise_m)
    if share is not None:
        items.append(("Recovered", words.percent(share), "of the excess over the noise (squares)"))
    train = paragraph(
        (
            f"On the data that were fitted: {words.length(before.train_rms_m)} before, {words.length(after.train_rms_m)} "
            f"after (rms)."
        ),
        class_="soft",
    )
    known = words.known(before.train_rms_m) or words.known(after.train_rms_m)
    return together(tiles(items) if items else None, train if known else None)


def has_markers(loop: Loop) -> bool:
    """Return whether markers were used; else the rows are points of the surface, measured along its normals."""
    return "markers" in loop.data.measured


def recovered(before_m: float | None, after_m: float | None, noise_m: float | None) -> float | None:
    """Return the share of the excess over the noise (in squares) that is gone; None where there is none to speak of."""
    if not (words.known(before_m) and words.known(after_m) and words.known(noise_m)):
        return None
    assert before_m is not None and after_m is not None and noise_m is not None
    excess = before_m**2 - noise_m**2
    if excess <= 0.1 * before_m**2:
        return None
    return min(1.0, max(0.0, (before_m**2 - after_m**2) / excess))
