"""Comparison of a run with the ground truth of a simulated recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from femsense.core.arrays import FloatArray
from femsense.core.errors import InputError
from femsense.io.result_folder import read_document
from femsense.io.tables import read_csv
from femsense.sensing.run_arrays import sensed
from femsense.sensing.types import ContactForce, Run

TRUTH = "femsense-truth-1"
SAME_PLACE = 0.1
"""Maximum distance between a true contact and its estimate, relative to the robot's size."""


@dataclass(frozen=True, eq=False, slots=True)
class TrueContact:
    """A contact of the ground truth."""

    frame: int
    position_m: FloatArray
    force_n_xyz: FloatArray


@dataclass(frozen=True, eq=False, slots=True)
class Comparison:
    """Result of `compare`: estimated contacts paired with true ones, and their errors. k contacts were found."""

    pairs: tuple[tuple[TrueContact, ContactForce], ...]
    """Found contacts: the true and the estimated one."""
    contacts_true: int
    """Number of true contacts, counted per frame: one that lasts six frames counts six times."""
    contacts_false: int
    """Number of estimated contacts without a true one, counted per frame."""

    @property
    def contacts_found(self) -> int:
        """Number of found contacts."""
        return len(self.pairs)

    @property
    def force_errors_n(self) -> FloatArray:
        """Magnitude of the force error of each found contact [N], shape (k,)."""
        return np.array([float(np.linalg.norm(found.force_n_xyz - true.force_n_xyz)) for true, found in self.pairs])

    @property
    def place_errors_m(self) -> FloatArray:
        """Distance of each found contact point from the true one [m], shape (k,)."""
        return np.array([float(np.linalg.norm(found.position_m - true.position_m)) for true, found in self.pairs])

    @property
    def force_shares(self) -> FloatArray:
        """Force errors relative to the true magnitude, shape (k,)."""
        return np.asarray(self.force_errors_n / np.array([float(np.linalg.norm(true.force_n_xyz)) for true, _ in self.pairs]))

    def __repr__(self) -> str:
        found = f"Comparison({self.contacts_found} of {self.contacts_true} contacts in frames found, {self.contacts_false} that are none"
        if not self.pairs:
            return found + ")"
        force, share, place = (float(np.median(x)) for x in (self.force_errors_n, self.force_shares, self.place_errors_m))
        return f"{found}; median errors {force:.3g} N ({100 * share:.1f} %), {1e3 * place:.2g} mm)"


def compare(run: Run, truth: str | Path | Sequence[TrueContact]) -> Comparison:
    """Compare a run with the ground truth of a simulated recording, frame by frame.

    A true contact is found if an estimated one in the same frame lies within a tenth of the robot's size. Estimated forces below three standard
    deviations, and true forces of zero, are ignored.

    Arguments:
        run: result of `estimate`.
        truth: folder of a simulated recording, or a list of `femsense.sensing.comparison.TrueContact`.

    Returns:
        the pairs of true and estimated contacts, the errors of force [N] and contact point [m], and the number of false contacts.

    Raises:
        InputError: a recording without ground truth, or another recording than that of the run.

    Example:
        >>> import femsense as fs
        >>> robot = fs.load_robot("finger")
        >>> folder = fs.robot_names()["finger"] / "recordings" / "press"
        >>> recording = fs.load_recording(folder)
        >>> robot = fs.apply_effects(robot, [{"name": "cable_friction", "coefficient": 0.15}])
        >>> run = fs.estimate(robot, recording, fs.calibrate(robot, recording), at=[0.088, 0.0, 0.014])
        >>> comparison = fs.compare(run, folder)
        >>> comparison.contacts_true, len(comparison.pairs), comparison.contacts_false
        (3, 3, 0)
    """
    if isinstance(truth, str | Path):
        if not (Path(truth) / "truth" / "contacts.csv").is_file():
            raise InputError("no truth beside the recording", where=truth, expected="a folder that femsense simulate wrote")
        _check_recording(run, Path(truth))
        truth = read_truth(Path(truth))
    size = float(np.linalg.norm(np.ptp(run.states.rest_nodes_m, axis=0)))
    truth, contacts = [true for true in truth if true.force_n_xyz.any()], sensed(run.contacts)
    pairs = [(true, found) for true in truth if (found := _nearest(contacts, true, SAME_PLACE * size)) is not None]
    return Comparison(tuple(pairs), len(truth), len(contacts) - len({id(found) for _, found in pairs}))


def read_truth(recording: Path) -> tuple[TrueContact, ...]:
    """Return the true contacts of a simulated recording; empty if it has none."""
    file = recording / "truth" / "contacts.csv"
    if not file.is_file():
        return ()
    columns_used = ("x_m", "y_m", "z_m", "fx_n", "fy_n", "fz_n")
    optional = ("time_s", "contact", "nx", "ny", "nz", "force_n", "radius_m", "object")
    table = read_csv(file, required=("frame", *columns_used), optional=optional, prefixes=("rest_",))
    frames, values = table.integers("frame"), table.numbers(columns_used)
    return tuple(TrueContact(int(frame), row[:3], row[3:]) for frame, row in zip(frames, values))


def _check_recording(run: Run, truth: Path) -> None:
    """Raise InputError unless the run was computed from this recording or a copy of it."""
    own = run.recording_folder
    if own is not None and own.resolve() == truth.resolve():
        return
    document = truth / "truth" / "truth.json"
    robot = read_document(document, TRUTH).get("robot") if document.is_file() else run.robot.name
    if robot != run.robot.name:
        raise InputError(
            "the truth of another robot", where=truth, found=robot, expected=f"{run.robot.name}, which the run is of"
        )
    here, there = truth / "frames.csv", None if own is None else own / "frames.csv"
    same = _times(here) >= {(frame.frame, round(frame.time_s, 6)) for frame in run.frames}
    if there is not None and there.is_file():
        same = same and there.read_bytes() == here.read_bytes()
    if not same:
        raise InputError(
            "the truth of another recording",
            where=truth,
            found="frames at other times or under other inputs",
            expected=f"the recording that the run is of: {own or 'not known any more'}",
        )


def _times(frames: Path) -> set[tuple[int, float]]:
    """Return number and time of each frame of a recording."""
    if not frames.is_file():
        return set()
    table = read_csv(frames, required=("frame", "time_s"), prefixes=("",))
    times = table.numbers(("time_s",))[:, 0]
    return {(int(frame), round(float(time), 6)) for frame, time in zip(table.integers("frame"), times)}


def _nearest(contacts: Sequence[ContactForce], true: TrueContact, reach: float) -> ContactForce | None:
    near = [contact for contact in contacts if contact.frame == true.frame]
    best = min(near, key=lambda contact: float(np.linalg.norm(contact.position_m - true.position_m)), default=None)
    return best if best is not None and np.linalg.norm(best.position_m - true.position_m) < reach else None
