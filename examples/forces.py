"""From a recording to forces: calibrate, estimate, write, export. The recording is the one that comes along.

python examples/forces.py [FOLDER FOR THE RESULTS]
"""

from __future__ import annotations

import sys
from pathlib import Path

import femsense as fs

FRAMES = range(36, 40)
"""Of the demo's recording: something touches the robot in the last two."""


def main(folder: Path) -> None:
    """Write a run and its moving mesh into a folder."""
    robot = fs.load_robot("four-leg")
    recording = fs.load_recording(fs.robot_names()["four-leg"] / "recordings" / "demo")
    calibration = fs.calibrate(robot, recording)
    print(f"calibration: {calibration.status}, {1e3 * calibration.rms_m:.2f} mm rms")

    part = fs.select_frames(recording, FRAMES)
    run = fs.estimate(robot, part, calibration)
    for contact in run.contacts:
        print(f"frame {contact.frame}: {contact.force_n:.2f} ± {contact.std_n:.2f} N at {(1e3 * contact.position_m).round(1)} mm")

    fs.write_run(run, folder, inputs=fs.run_inputs(robot, part, calibration), calibration=calibration)
    mesh = fs.export_glb(run, folder / "robot.glb")
    print(f"{mesh.path}: {mesh.bones} bones, {1e3 * mesh.rms_m:.3f} mm rms from the finite elements")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "forces-example"))
