"""What `femsense doctor` finds in this installation, and what it advises where something is missing."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numba
import pytest

from femsense.app import cli
from femsense.app.doctor import diagnose, import_hint


def test_this_installation_solves_and_says_with_what(capfd: pytest.CaptureFixture[str]) -> None:
    status = cli.run(["doctor", "--json"])
    report = json.loads(capfd.readouterr().out)
    checks = {check["name"]: check for check in report["checks"]}
    assert status == (0 if report["ok"] else 2)
    assert checks["python"]["level"] == checks["numpy"]["level"] == checks["a tiny solve"]["level"] == "ok"
    assert "converged" in checks["a tiny solve"]["found"]
    assert "Cholesky" in checks["linear solver"]["found"]


def test_a_package_that_is_missing_is_an_error_with_its_install_line() -> None:
    report = diagnose({"numpy": "numpy", "not_there": "some-package"})
    (missing,) = [check for check in report["checks"] if check["level"] == "error"]
    assert not report["ok"] and missing["name"] == "not_there" and missing["hint"] == "pip install some-package"


@pytest.mark.parametrize(
    ("message", "hint"),
    [
        ("libGL.so.1: cannot open shared object file: No such file or directory", "apt-get install libgl1"),
        ("libusb-1.0.so.0: cannot open shared object file", "apt-get install libusb-1.0-0"),
        ("No module named 'x'", "pip install p"),
    ],
)
def test_a_library_of_the_system_is_named_by_its_package(message: str, hint: str) -> None:
    assert import_hint(message, "p").endswith(hint)


@pytest.mark.parametrize(
    ("version", "count", "level", "said"),
    [
        (numba.__version__, 59, "ok", "59 functions"),
        (numba.__version__, 31, "warning", "31 functions"),
        ("0.1", 59, "warning", "another"),
    ],
)
def test_whether_compiled_kernels_came_along(
    version: str, count: int, level: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    for number in range(count):
        (tmp_path / f"kernel-{number}.nbi").write_bytes(pickle.dumps(version))
    (check,) = [check for check in diagnose({})["checks"] if check["name"] == "compiled kernels"]
    assert check["level"] == level and said in check["found"]
    assert (check["hint"] is None) == (level == "ok")
