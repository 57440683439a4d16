"""The interface to the estimator: all of `live` uses it through `Senser` only."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from femsense.calib.calibration import Calibration
from femsense.core.arrays import FloatArray
from femsense.core.errors import FemsenseError
from femsense.core.parallel import one_blas_thread
from femsense.model.drive import DrivenRobot, drive_of
from femsense.model.recording import Recording
from femsense.model.robot import Robot
from femsense.sensing.contact_free import learn
from femsense.sensing.estimate_frame import sense
from femsense.sensing.pipeline import under_inputs
from femsense.sensing.prepare import make_sensor
from femsense.sensing.status import Status
from femsense.sensing.types import ContactForce, FrameReport, SensedFrame

NAN = float("nan")


@dataclass(frozen=True, eq=False, slots=True)
class Answer:
    """The estimator's result for one frame."""

    report: FrameReport
    contacts: tuple[ContactForce, ...]
    """With their tracks."""
    positions: FloatArray
    """Nodes of the deformed body [m], shape (n, 3); without a result, those of the last predicted state."""

    @property
    def is_ok(self) -> bool:
        """Whether the status is ok."""
        return self.report.status == Status.OK.value

    @property
    def is_contact_free(self) -> bool:
        """Whether the status is ok and there is no contact."""
        return self.is_ok and not self.contacts


class Senser:
    """Processes the frames of a growing recording one after another, with the same results as `estimate` on the complete recording.

    Noise, pose corrections and model error are estimated from the contact-free frames present at construction. Later frames must not be
    declared contact-free, or `estimate` would use them too.
    """

    def __init__(self, robot: Robot, recording: Recording, calibration: Calibration) -> None:
        """Process the contact-free frames of a recording. Raises as `estimate`."""
        with one_blas_thread():
            self._model = learn(make_sensor(robot, recording, calibration))
        table = calibration.cable_tension_n if recording.actuation == "tension" else calibration.cable_displacement_m
        unknown = recording.actuation_zero == "unknown"
        self._initial = np.array([table[name] for name in robot.body.cable_names]) if unknown else None
        self._previous: SensedFrame | None = None
        self._positions: FloatArray = robot.body.mesh.nodes
        self._tracks = 0

    def sense(self, recording: Recording, k: int) -> Answer:
        """Return contacts and forces of frame k.

        Arguments:
            recording: containing at least the frames up to k.
            k: index 0 … F − 1; earlier frames must have been processed in order.

        Returns:
            the result; without contacts and state, the status gives the reason.
        """
        robot = self._model.sensor.robot
        driven = DrivenRobot(robot, drive_of(robot, recording, initial=self._initial))
        uncorrected = np.zeros(len(recording.marker_frame))
        sensor = replace(self._model.sensor, recording=recording, driven=driven, correction_std=uncorrected)
        self._model = replace(self._model, sensor=sensor)
        try:
            with one_blas_thread():
                frame = sense(self._model, k, self._previous)
        except (FemsenseError, np.linalg.LinAlgError) as error:
            if self._previous is not None:
                self._positions = self._previous.free_state.positions
            return Answer(self._without_result(recording, k, error), (), self._positions)
        contacts = tuple(self._tracked(contact) for contact in frame.contacts)
        self._positions = frame.state.positions
        self._previous = replace(frame, contacts=contacts) if frame.trusted else under_inputs(frame)
        return Answer(frame.report, contacts, self._positions)

    def _tracked(self, contact: ContactForce) -> ContactForce:
        """Return a contact with a new track number if it begins a track."""
        if contact.track >= 0:
            return contact
        self._tracks += 1
        return replace(contact, track=self._tracks - 1)

    def _without_result(self, recording: Recording, k: int, error: Exception) -> FrameReport:
        body = self._model.sensor.robot.body
        what = f"its equations have no solution: {error}" if isinstance(error, np.linalg.LinAlgError) else str(error)
        number, time_s = int(recording.frame_numbers[k]), float(recording.time_s[k])
        status = " ".join(what.split())
        tensions, pressures = dict.fromkeys(body.cable_names, NAN), dict.fromkeys(body.chamber_names, NAN)
        return FrameReport(number, time_s, status, 0, 0, NAN, NAN, NAN, tensions, pressures)
