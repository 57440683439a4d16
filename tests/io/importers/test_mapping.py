"""`--map`: units beside the names that are mapped, names that are not there, targets that are none."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from imported import imported

from femsense.core.errors import InputError
from femsense.io.importers.guess import open_source, open_sources
from femsense.io.importers.options import Options
from femsense.io.importers.tables.actuation import read_actuation_log

NEXUS = "Trajectories\n100\n,,arm:base,,,arm:tip,,\nFrame,Sub Frame,X,Y,Z,X,Y,Z\n,,mm,mm,mm,mm,mm,mm\n" + "".join(
    f"{k},0,1,2,3,100,200,{300 + k}\n" for k in range(4)
)


def table(path: Path, head: str, *rows: Sequence[float]) -> Path:
    path.write_text("\n".join([head, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


@pytest.mark.parametrize(
    ("name", "target", "value"),
    [
        ("pos [mm]", "cable_a", 2e-3),
        ("pos_mm", "cable_a", 2e-3),
        ("p [kPa]", "chamber_q", 2e3),
        ("p_MPa", "chamber_q", 2e6),
        ("motor [mN]", "cable_a", 2e-3),
        ("motor (mN)", "cable_a*10", 20.0),
        ("motor", "cable_a", 2.0),
    ],
)
def test_a_unit_beside_a_name_counts_in_a_mapping(name: str, target: str, value: float, tmp_path: Path) -> None:
    file = table(tmp_path / "take.csv", f"time,{name},tip_x_m,tip_y_m,tip_z_m", (0, 1, 0, 0, 1), (1, 2, 0, 0, 1))
    kind = "displacement" if "pos" in name else "tension"
    recording, _ = imported(file, tmp_path, Options(columns={name: target}), actuation=kind)
    found = recording.pressures if "chamber" in target else recording.inputs
    np.testing.assert_allclose(found[1], [value])
    log = read_actuation_log(file, Options(columns={name: target}))
    np.testing.assert_allclose(log.values[1], [value])


def test_a_unit_below_the_names_counts_and_says_what_cables_hold(tmp_path: Path) -> None:
    file = tmp_path / "take.csv"
    file.write_text("Zeit,pull,tip_x,tip_y,tip_z\nms,mN,mm,mm,mm\n0,1,0,0,900\n500,2,0,0,900\n")
    options = Options(columns={"Zeit": "time", "pull": "cable_a"})
    recording, _ = imported(file, tmp_path, options)
    assert recording.actuation == "tension"
    np.testing.assert_allclose(recording.time_s, [0, 0.5])
    np.testing.assert_allclose(recording.inputs[:, 0], [1e-3, 2e-3])
    with pytest.raises(InputError, match="units of the cables"):
        imported(file, tmp_path / "other", options, actuation="displacement")


@pytest.mark.parametrize(
    ("name", "target"), [("m [V]", "cable_a"), ("p [mm]", "chamber_a"), ("f_kPa", "cable_a"), ("w [°]", "cable_a")]
)
def test_a_unit_of_another_quantity_asks_for_a_factor(name: str, target: str, tmp_path: Path) -> None:
    file = table(tmp_path / "log.csv", f"time,{name}", (0, 1), (1, 2))
    with pytest.raises(InputError, match="FACTOR"):
        read_actuation_log(file, Options(columns={name: target}))


@pytest.mark.parametrize(
    "columns",
    [
        {"motor": "cable_a"},
        {"tip": "cable_a"},
        {"tip": "tip.x"},
        {"tip": "marker.base"},
        {"tip": "marker.a,b"},
        {"tip": "marker."},
        {"tip": "cabel_a"},
        {"tip": "marker.a", "base": "marker.a"},
        {"tip": "cable_a*x"},
        {"tip": "cable_a*0"},
    ],
)
def test_a_mapping_that_takes_nothing_is_refused(columns: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "vicon.csv").write_text(NEXUS)
    with pytest.raises(InputError, match="--map"):
        open_source(tmp_path / "vicon.csv", Options(columns=columns))


def test_names_that_are_there_are_listed_of_all_sources(tmp_path: Path) -> None:
    (tmp_path / "vicon.csv").write_text(NEXUS)
    other = table(tmp_path / "side.csv", "time,m", *((0.01 * k, k) for k in range(4)))
    paths = [tmp_path / "vicon.csv", other]
    source = open_sources(paths, Options(columns={"tip": "marker.end", "m": "cable_a"}))
    assert next(source.frames()).inputs == {"cable_a": 0.0}
    with pytest.raises(InputError, match="base, tip, arm:base, arm:tip, time, m"):
        open_sources(paths, Options(columns={"tp": "marker.end", "m": "cable_a"}))
