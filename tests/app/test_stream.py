"""`femsense stream` and `view --stream`: from a run on one end to a viewer on the other."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from streams import within
from xr_bar import write_run_with_mesh

from femsense.app.stream_command import StreamOptions, need_one, show_stream, stream_document, stream_runs, stream_text
from femsense.core.errors import InputError

pytest.importorskip("websockets")
pytest.importorskip("amqtt")


@pytest.fixture
def page(tmp_path: Path) -> Path:
    folder = tmp_path / "page"
    folder.mkdir()
    (folder / "index.html").write_text("<p>page</p>", encoding="utf-8")
    return folder


def test_two_runs_reach_a_viewer_of_a_viewer(tmp_path: Path, page: Path) -> None:
    run = write_run_with_mesh(tmp_path / "bar")
    with (
        stream_runs([run, run], StreamOptions(page=page, broker_port=0, json_mirror=True)) as live,
        show_stream(live.url, page=page) as shown,
    ):
        said = stream_document(live)
        assert said["robots"] == ["bar", "bar-2"] and said["url"] == live.url and said["broker_port"] > 0
        assert live.url in stream_text(live) and "femsense/bar-2" in stream_text(live)
        for robot in said["robots"]:
            assert within(10.0, lambda name=robot: f"femsense/{name}/pose_json" in shown.hub.newest())
            assert shown.hub.newest()[f"femsense/{robot}/glb"].payload[:4] == b"glTF"
    assert json.loads(live.hub.newest()["femsense/bar/status"].payload)["state"] == "ended"


def test_a_run_that_is_played_once_ends_and_says_so(tmp_path: Path, page: Path) -> None:
    run = write_run_with_mesh(tmp_path / "bar")
    with stream_runs([run], StreamOptions(page=page), loop=False) as live:
        live.wait()
        assert b"ended" in live.hub.newest()["femsense/bar/status"].payload and live.publishers[0].sent > 100


def test_a_password_travels_encrypted_or_it_is_said(tmp_path: Path, page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FEMSENSE_PASSWORD", "secret")
    with stream_runs([write_run_with_mesh(tmp_path / "bar")], StreamOptions(page=page)) as live:
        assert "unencrypted" in stream_text(live) and "secret" not in stream_text(live)
    (tmp_path / "empty").write_text("\n", encoding="utf-8")
    with pytest.raises(InputError, match="password is empty"):
        show_stream("http://127.0.0.1:1", page=page, password_file=tmp_path / "empty")


def test_commands_that_name_nothing_or_too_much_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    from femsense.app.cli import run

    assert run(["stream"]) == 2 and "one of both" in capsys.readouterr().err
    assert run(["stream", "no-such-run"]) == 2 and "no states.npz" in capsys.readouterr().err
    assert run(["view"]) == 2 and "nothing to show" in capsys.readouterr().err
    assert run(["view", "a-run", "--stream", "http://127.0.0.1:1"]) == 2
    with pytest.raises(InputError):
        need_one([Path("x")], "udp://:1")
