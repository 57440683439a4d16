"""The list of alternative readings. A further one is a generator like these, and a name here."""

from __future__ import annotations

from femsense.calib.body_readings import direction_of_gravity, modulus
from femsense.calib.camera_readings import declared_pose, moved_camera, pose_at_rest
from femsense.calib.input_readings import input_of_one_cable, inputs_otherwise, zero_of_inputs
from femsense.calib.marker_readings import exchanged_labels, left_handed, marker_scale
from femsense.calib.readings import Reread

OF_MARKERS: tuple[Reread, ...] = (left_handed, exchanged_labels)
"""Compared before labels and outliers of single frames are corrected: a mirrored body that is symmetric fits under other labels in single frames."""
OF_SMALL_ERRORS: tuple[Reread, ...] = (declared_pose, input_of_one_cable, marker_scale)
"""Compared whatever the misfit is: poses and inputs absorb most of such an error."""
OF_LARGE_ERRORS: tuple[Reread, ...] = (
    pose_at_rest,
    moved_camera,
    inputs_otherwise,
    zero_of_inputs,
    direction_of_gravity,
    modulus,
)
"""Compared where the misfit is suspicious."""
