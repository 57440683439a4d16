"""An import that is refused leaves nothing, whatever stood there before, and a second call says the same."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from femsense.app.import_command import import_into
from femsense.core.errors import FemsenseError
from femsense.io.importers.options import Options

GOOD = "time,tip_x,tip_y,tip_z\n0,0.1,0.2,0.3\n1,0.1,0.2,0.31\n2,0.1,0.2,0.32\n"
BAD = {
    "millimetres as metres": GOOD.replace("0.", "100."),
    "a broken row at the end": GOOD + "x,y,z,w\n3,0.1,0.2,0.3\n",
    "a clock that stands still": GOOD.replace("\n1,", "\n0,").replace("\n2,", "\n0,"),
    "displacements of no cable": GOOD.replace("tip_z", "cable_top [m]").replace("0.3", "2048"),
}


def everything(folder: Path) -> dict[str, bytes]:
    return {item.relative_to(folder).as_posix(): item.read_bytes() for item in folder.rglob("*") if item.is_file()}


def refusal(call: Callable[[], object]) -> str:
    with pytest.raises(FemsenseError) as error:
        call()
    return str(error.value)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("name", list(BAD))
@pytest.mark.parametrize("place", ["out", "new/deep/out"])
def test_nothing_is_left_and_a_second_call_says_the_same(name: str, place: str, tmp_path: Path) -> None:
    source = tmp_path / "take.csv"
    source.write_text(BAD[name])

    def call() -> object:
        return import_into(tmp_path / place, [source], Options(unit="m"), say=print)

    first = refusal(call)
    assert [item.name for item in tmp_path.iterdir()] == ["take.csv"]
    assert refusal(call) == first and ".part-" not in first


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_what_stood_there_stays(tmp_path: Path) -> None:
    (tmp_path / "take.csv").write_text(GOOD)
    import_into(tmp_path / "out", [tmp_path / "take.csv"], Options(unit="m"), say=print)
    before = everything(tmp_path / "out")
    (tmp_path / "take.csv").write_text(BAD["millimetres as metres"])
    refusal(lambda: import_into(tmp_path / "out", [tmp_path / "take.csv"], Options(unit="m"), say=print, again=True))
    assert everything(tmp_path / "out") == before
    (tmp_path / "empty").mkdir()
    refusal(lambda: import_into(tmp_path / "empty", [tmp_path / "take.csv"], Options(unit="m"), say=print))
    assert sorted(item.name for item in tmp_path.iterdir()) == ["empty", "out", "take.csv"]


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_an_import_says_what_inspect_says(tmp_path: Path) -> None:
    from femsense.app.inspect import inspect_path

    rows = "".join(f"{0.05 * k:.2f},0.1,0.2,0.9,{0.2 * k}\n" for k in range(6))
    (tmp_path / "take.csv").write_text("time,tip_x_m,tip_y_m,tip_z_m,chamber_a\n" + rows)
    with pytest.warns(UserWarning, match=r"chamber 'a' reaches 1 Pa; is it in bar") as caught:
        import_into(tmp_path / "out", [tmp_path / "take.csv"], Options(), say=print)
    said = next(str(item.message) for item in caught if "reaches" in str(item.message))
    assert said in inspect_path(tmp_path / "out")["warnings"]


def test_a_unit_in_any_spelling_and_names_in_either(tmp_path: Path) -> None:
    (tmp_path / "take.csv").write_text("time,e\u0301_x,e\u0301_y,e\u0301_z\n0,100,200,300\n1,100,200,301\n", encoding="utf-8")
    columns = {f"é_{axis}": f"tip.{axis}" for axis in "xyz"}
    found = import_into(tmp_path / "out", [tmp_path / "take.csv"], Options(unit="MM", columns=columns), say=print)
    assert found["markers"] == ["tip"]
    np.testing.assert_allclose(found["span_m"], [0, 0, 1e-3], atol=1e-9)
