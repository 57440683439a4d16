"""The page: what is served, what it is told about contacts, and the page itself in a browser."""

from __future__ import annotations

import json
import os
import re
import struct
import threading
import tomllib
import urllib.error
import urllib.request
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import CHROMIUM, VIEWER, run_in_browser
from glb import Glb, in_gltf
from helpers import write_block_robot
from xr_bar import START, bar_mesh, write_run

from femsense.core.errors import InputError, MissingDependency
from femsense.fem.mesh import to_quadratic
from femsense.xr import run_contents, view
from femsense.xr.export import export_glb
from femsense.xr.surface_stress import nodal_strain


@pytest.fixture
def page(tmp_path: Path) -> Path:
    """A page of two files: enough for all but the browser."""
    folder = tmp_path / "page"
    folder.mkdir()
    (folder / "index.html").write_text("<p>page</p>", encoding="utf-8")
    (folder / "app.js").write_text("1", encoding="utf-8")
    (folder / ".sources").write_text("digest", encoding="utf-8")
    return folder


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_run(tmp_path / "bent-bar")


def get(url: str) -> tuple[int, str, bytes]:
    try:
        with urllib.request.urlopen(url, timeout=10) as answer:
            return answer.status, answer.headers["Content-Type"], answer.read()
    except urllib.error.HTTPError as error:
        return error.code, "", b""


# ---- what is served ----------------------------------------------------------------------------------------------------------


def test_serves_page_mesh_and_contacts_and_nothing_else(run: Path, page: Path) -> None:
    with view.serve(run, open_browser=False, page=page) as server:
        assert server.server_address[0] == "127.0.0.1"
        assert get(server.url) == (200, "text/html", b"<p>page</p>")
        assert get(server.url + "app.js?x=1")[:2] == (200, "text/javascript")
        status, kind, glb = get(server.url + "robot.glb")
        assert (status, kind, glb[:4]) == (200, "model/gltf-binary", b"glTF")
        assert json.loads(get(server.url + "contacts.json")[2])["format"] == "femsense-contacts-1"
        for path in ("states.npz", "../bent-bar/states.npz", "%2e%2e/page/index.html", ".sources", "/etc/passwd"):
            assert get(server.url + path)[0] == 404
        url = server.url
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(url, timeout=2)


def test_mesh_is_made_once_and_again_when_the_states_are_newer(run: Path, page: Path) -> None:
    view.serve(run, open_browser=False, page=page).stop()
    first = (run / "robot.glb").stat().st_mtime_ns
    assert len(Glb(run / "robot.glb").times) == 24
    view.serve(run, open_browser=False, page=page).stop()
    assert (run / "robot.glb").stat().st_mtime_ns == first
    write_run(run, frames=9)
    os.utime(run / "robot.glb", (0, 0))
    view.serve(run, open_browser=False, page=page).stop()
    assert len(Glb(run / "robot.glb").times) == 9


def test_port_in_use_is_said(run: Path, page: Path) -> None:
    with view.serve(run, open_browser=False, page=page) as server, pytest.raises(InputError, match="cannot be served"):
        view.serve(run, port=server.server_address[1], open_browser=False, page=page)


def test_page_that_was_not_built_is_said(run: Path, tmp_path: Path) -> None:
    with pytest.raises(MissingDependency, match="pip install"):
        view.serve(run, open_browser=False, page=tmp_path / "nothing")


def test_static_page(run: Path, page: Path, tmp_path: Path) -> None:
    index = view.write_static_page(run, tmp_path / "out", page=page)
    assert index == tmp_path / "out" / "index.html"
    assert sorted(p.name for p in index.parent.iterdir()) == ["app.js", "contacts.json", "fields.bin", "index.html", "robot.glb"]


def test_a_page_is_not_written_over_another(run: Path, page: Path, tmp_path: Path) -> None:
    out = tmp_path / "mine"
    out.mkdir()
    (out / "index.html").write_text("mine")
    with pytest.raises(InputError, match="the folder contains other files"):
        view.write_static_page(run, out, page=page)
    assert (out / "index.html").read_text() == "mine"
    (out / "index.html").unlink()
    (tmp_path / "link").symlink_to(tmp_path / "later")
    assert view.write_static_page(run, tmp_path / "link", page=page).is_file() and (tmp_path / "later").is_dir()
    for _ in range(2):  # its own page it writes anew
        view.write_static_page(run, out, page=page)


def test_a_mesh_goes_where_links_lead_and_into_pipes(run: Path, tmp_path: Path) -> None:
    (tmp_path / "link.glb").symlink_to(tmp_path / "real.glb")
    export_glb(run, tmp_path / "link.glb", bones=2)
    assert (tmp_path / "link.glb").is_symlink() and (tmp_path / "real.glb").read_bytes()[:4] == b"glTF"
    os.mkfifo(tmp_path / "pipe.glb")
    got: list[bytes] = []
    reader = threading.Thread(target=lambda: got.append((tmp_path / "pipe.glb").read_bytes()), daemon=True)
    reader.start()
    export_glb(run, tmp_path / "pipe.glb", bones=2)
    reader.join(timeout=20)
    assert got[0][:4] == b"glTF" and (tmp_path / "pipe.glb").is_fifo()


# ---- what the page is told -----------------------------------------------------------------------------------------------------


def test_contacts_go_with_their_frames(run: Path) -> None:
    told = view.contacts_of_run(run)
    states = np.load(run / "states.npz")
    np.testing.assert_allclose([f["time_s"] for f in told["frames"]], states["time_s"] - START, atol=1e-12)
    assert told["name"] == "bent-bar" and told["frame"] == "robot"
    assert [len(f["contacts"]) for f in told["frames"]] == [0] * 3 + [1] * 18 + [0] * 3
    (contact,) = told["frames"][12]["contacts"]
    assert contact["force_vector_n"] == pytest.approx([-2.0, 0.0, 0.0]) and contact["force_n"] == pytest.approx(2.0)
    assert (contact["contact"], contact["std_n"], contact["source"]) == (1, 0.1, "cloud")
    assert told["frames"][12]["frame"] == 22
    nodes = states["nodes_m"][12]
    assert np.linalg.norm(nodes - contact["point_m"], axis=1).min() < 1e-6


def test_run_without_contacts_and_with_gaps(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", contacts=False)
    assert all(f["contacts"] == [] for f in view.contacts_of_run(run)["frames"])
    (run / "frames.csv").write_text("frame,time_s,status,rms_after_m\n7,2.0,converged,0.0012\n8,4.0,,nan\n", encoding="utf-8")
    first, last = (view.contacts_of_run(run)["frames"][i] for i in (0, -1))
    assert (first["frame"], first["status"], first["rms_after_m"]) == (7, "converged", 0.0012)
    assert (last["frame"], last["status"], last["rms_after_m"]) == (8, None, None)
    json.dumps(view.contacts_of_run(run), allow_nan=False)


def test_refusals_name_the_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"states\.npz"):
        view.contacts_of_run(tmp_path)
    run = write_run(tmp_path / "run")
    table = (run / "contacts.csv").read_text(encoding="utf-8")
    (run / "contacts.csv").write_text(table.replace("force_n", "newton", 1), encoding="utf-8")
    with pytest.raises(InputError, match=r"contacts\.csv.*columns are missing[\s\S]*force_n"):
        view.contacts_of_run(run)
    (run / "contacts.csv").write_text(re.sub("cloud", "cloud", table).replace(",0.1,", ",much,", 1), encoding="utf-8")
    with pytest.raises(InputError, match=r"contacts\.csv, line 2, column std_n.*not a number[\s\S]*much"):
        view.contacts_of_run(run)
    (run / "states.npz").write_bytes(b"not an archive")
    with pytest.raises(InputError, match="not readable"):
        view.contacts_of_run(run)
    np.savez(run / "states.npz", time_s=[0.0])
    with pytest.raises(InputError, match="nodes_m, tets"):
        run_contents.export_run(run, tmp_path / "x.glb")


@pytest.mark.parametrize("quadratic", [False, True])
def test_strain_of_a_stretched_and_of_a_turned_body_is_the_textbook_s(quadratic: bool) -> None:
    mesh = to_quadratic(bar_mesh((1, 1, 4))) if quadratic else bar_mesh((1, 1, 4))
    stretched = mesh.nodes * [1.0, 1.0, 1.1]
    turned = mesh.nodes @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) + 0.3
    strain = nodal_strain(mesh.nodes, mesh.tets, np.array([mesh.nodes, stretched, turned]))
    np.testing.assert_allclose(strain[[0, 2]], 0.0, atol=1e-12)
    np.testing.assert_allclose(strain[1], 2.0 / 3.0 * 0.5 * (1.1**2 - 1.0))  # E = diag(0, 0, e): √(2/3) |dev E| = 2/3 e


def test_landmarks_are_markers_of_the_robot_and_the_calibrated_camera(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    assert view.contacts_of_run(run)["markers"] == [] and view.contacts_of_run(run)["field"]["name"] == "strain"
    robot = write_block_robot(tmp_path / "robot")
    (run / "run.json").write_text(json.dumps({"inputs": {"robot": {"path": str(robot)}}}), encoding="utf-8")
    T = np.eye(4)
    T[:3, 3] = [0.1, 0.2, 0.3]
    name = tomllib.loads((robot / "robot.toml").read_text(encoding="utf-8"))["markers"][0]["name"]
    told = {"T_robot_camera": T.tolist(), "placements_m": {name: [1.0, 2.0, 3.0], "another": [0.0, 0.0, 0.0]}}
    (run / "calibration.json").write_text(json.dumps(told), encoding="utf-8")
    known = view.contacts_of_run(run)
    assert known["cameras"] == [{"name": "the camera", "position": [0.1, 0.2, 0.3]}] and known["field"]["unit"] == "Pa"
    places = {marker["name"]: marker["position"] for marker in known["markers"]}
    assert places[name] == [1.0, 2.0, 3.0] and "another" not in places and len(places) > 1


@pytest.mark.parametrize(
    ("limit", "high", "whose"),
    [("max_tension_n = 1.6", 1.6, "declared"), ("", 1.4, "reached"), ("max_tension_n = 1.0", 1.4, "reached")],
)
def test_the_range_of_an_input_is_the_robot_s_or_said_to_be_the_run_s(
    tmp_path: Path, limit: str, high: float, whose: str
) -> None:
    run, robot = write_run(tmp_path / "run"), tmp_path / "robot"
    (run / "run.json").write_text(json.dumps({"inputs": {"robot": {"path": str(robot)}}}), encoding="utf-8")
    (run / "frames.csv").write_text("frame,time_s,tension_top_n\n7,2.0,0.0\n8,4.0,1.4\n", encoding="utf-8")
    robot.mkdir()
    (robot / "robot.toml").write_text(f'[[cables]]\nname = "top"\n{limit}\n', encoding="utf-8")
    assert view.contacts_of_run(run)["inputs"] == [{"name": "top", "unit": "N", "low": 0.0, "high": high, "range": whose}]


# ---- the sources of the page ----------------------------------------------------------------------------------------------------


def test_lock_file_holds_no_addresses() -> None:
    text = (VIEWER / "package-lock.json").read_text(encoding="utf-8")
    assert "resolved" not in text and "://" not in text
    packages = json.loads(text)["packages"]
    assert all("integrity" in entry for name, entry in packages.items() if name)
    assert packages["node_modules/three"]["version"] == json.loads((VIEWER / "package.json").read_text())["dependencies"]["three"]


def test_page_speaks_of_no_other_host() -> None:
    for source in (VIEWER / "src").iterdir():
        found = re.findall(r"https?://[^\s'\"]+", source.read_text(encoding="utf-8"))
        assert [f for f in found if not f.startswith("http://www.w3.org/")] == [], source.name


# ---- in a browser ------------------------------------------------------------------------------------------------------------------

LOOK = """
const [url, shot, phone] = given;
(async () => {
  const page = await opened.newPage({ viewport: { width: 900, height: 600 } });
  const problems = [], hosts = new Set();
  page.on('console', (m) => { if (m.type() === 'error') problems.push(m.text()); });
  page.on('pageerror', (e) => problems.push(e.message));
  page.on('request', (r) => { if (r.url().startsWith('http')) hosts.add(new URL(r.url()).host); });
  await page.goto(url + '?time=0.97&play=0', { timeout: 120000 });
  await page.waitForFunction(() => document.documentElement.dataset.state, null, { timeout: 120000 });
  const state = await page.evaluate(() => document.documentElement.dataset.state);
  const text = () => page.evaluate(() => document.body.innerText);
  const result = { state, problems, hosts: [...hosts], text: await text() };
  if (state === 'ready') {
    await page.waitForTimeout(500);
    await page.screenshot({ path: shot });
    const covered = () => page.evaluate(() => {               // how far corners of the space that is shown lie under panels [px]
      const { stage, shown } = femsense, { box, camera } = stage;
      const [dock, panel] = ['#dock', '#panel'].map((id) => document.querySelector(id).getBoundingClientRect());
      const over = panel.width > 0.6 * innerWidth, label = shown.body.arrows.group.children[0].children.at(-1);
      const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((i) => box.min.clone().set(...['x', 'y', 'z'].map((axis, k) => box[i >> k & 1 ? 'max' : 'min'][axis])));
      const under = corners.map((corner) => {
        const { x, y } = corner.project(camera), across = (x + 1) / 2 * innerWidth, down = (1 - y) / 2 * innerHeight;
        return Math.max(-across, across - (over ? innerWidth : panel.left), (over ? panel.bottom : 0) - down, down - dock.top);
      });
      const [end] = shown.body.arrows.ends(shown.run.frames[shown.shown].contacts);
      return { under: Math.max(...under), beyond: box.distanceToPoint(end), off: end.distanceTo(label.getWorldPosition(end.clone())) };
    });
    result.covered = [await covered()];
    const clock = () => page.textContent('#clock');
    await page.keyboard.press('ArrowRight');
    result.next = await clock();
    await page.keyboard.press('Home');
    result.home = await clock();
    await page.keyboard.press(' ');
    await page.waitForFunction(() => !document.querySelector('#clock').textContent.startsWith('0.00'), null, { timeout: 60000 });
    result.later = await clock();
    result.button = await page.getAttribute('#play', 'aria-label');
    await page.keyboard.press('f');
    result.forces = await page.getAttribute('#forces', 'aria-pressed');
    await page.keyboard.press(' ');
    await page.keyboard.press('Home');
    await page.selectOption('#paint', 'stress');
    await page.waitForFunction(() => document.querySelector('#scale-top').textContent.includes('strain'), null, { timeout: 60000 });
    const paint = () => page.evaluate(() => {
      const p = femsense.shown.body.painter;
      return { field: Math.max(...p.attributes[0].array), mode: p.mode.value };
    });
    result.rest = await paint();
    for (let i = 0; i < 6; i++) await page.keyboard.press('ArrowRight');
    result.bent = { ...(await paint()), said: await page.textContent('#scale-top') };
    await page.waitForTimeout(200);
    await page.screenshot({ path: shot.replace('desk', 'stress') });
    await page.keyboard.press('m');
    result.contact = { ...(await paint()), place: await page.evaluate(() => femsense.shown.body.painter.places.value[0].toArray()) };
    await page.waitForTimeout(200);
    await page.screenshot({ path: shot.replace('desk', 'contact') });
    result.doubtful = await page.evaluate(() => ['not explained', 'ok'].map((status) => {
      const { shown } = femsense;
      shown.run.frames[shown.shown].status = status;
      shown.shown = -1;
      shown.seek(shown.time);
      return shown.body.isDoubtful;
    }));
    await page.selectOption('#paint', 'none');
    await page.setViewportSize({ width: 360, height: 740 });
    await page.waitForTimeout(300);
    await page.screenshot({ path: phone });
    result.covered.push(await covered());
    const panel = () => page.evaluate(() => {
      const panel = document.querySelector('#panel');
      return { below: panel.scrollHeight - panel.clientHeight - panel.scrollTop, said: !document.querySelector('#more').hidden };
    });
    result.panel = [await panel()];
    if (result.panel[0].said) await page.click('#more');
    await page.evaluate(() => { const p = document.querySelector('#panel'); p.scrollTop = p.scrollHeight; });
    await page.waitForTimeout(100);
    result.panel.push(await panel());
    await page.evaluate(() => { document.querySelector('#panel').style.maxHeight = '60px'; document.querySelector('#panel').scrollTop = 0; });
    await page.waitForTimeout(100);
    result.panel.push(await panel());
    result.overflow = await page.evaluate(() => document.documentElement.scrollWidth - window.innerWidth);
  }
  await opened.close();
  console.log(JSON.stringify(result));
})().catch((e) => { console.error(e); process.exit(1); });
"""


def look(request: pytest.FixtureRequest, url: str, folder: Path) -> dict[str, object]:
    """What a browser finds at the page."""
    return run_in_browser(request.config, LOOK, url, str(folder / "desk.png"), str(folder / "phone.png"))


def pixels(path: Path) -> np.ndarray:
    """Colours of an 8-bit PNG without interlacing, shape (h, w, 3)."""
    data, at, packed, head = path.read_bytes(), 8, b"", b""
    while at < len(data):
        (size,) = struct.unpack_from(">I", data, at)
        kind, body = data[at + 4 : at + 8], data[at + 8 : at + 8 + size]
        head, packed = (body, packed) if kind == b"IHDR" else (head, packed + body if kind == b"IDAT" else packed)
        at += 12 + size
    width, height, depth, color = struct.unpack_from(">IIBB", head)
    n = {2: 3, 6: 4}[color]
    assert depth == 8
    rows = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(height, 1 + n * width)
    image = np.zeros((height, width, n), np.uint8)
    above = np.zeros((width, n), int)
    for y, row in enumerate(rows):
        line, kind = row[1:].reshape(width, n).astype(int), row[0]
        if kind == 2:
            line = (line + above) % 256
        elif kind in (1, 3, 4):
            left, corner = np.zeros(n, int), np.zeros(n, int)
            for x in range(width):
                a, b, c = left, above[x], corner
                guess = a if kind == 1 else (a + b) // 2 if kind == 3 else _paeth(a, b, c)
                left = line[x] = (line[x] + guess) % 256
                corner = b
        image[y] = above = line
    return image[..., :3]


def _paeth(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    p = a + b - c
    pa, pb, pc = abs(p - a), abs(p - b), abs(p - c)
    return np.where((pa <= pb) & (pa <= pc), a, np.where(pb <= pc, b, c))


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_page_in_a_browser(request: pytest.FixtureRequest, run: Path, built_page: Path, tmp_path: Path) -> None:
    with view.serve(run, open_browser=False, page=built_page) as server:
        seen = look(request, server.url, tmp_path)
        assert seen["state"] == "ready" and seen["problems"] == []
        assert seen["hosts"] == [server.url.split("/")[2]]
    assert "24 frames" in str(seen["text"]) and "1.98 ± 0.10 N" in str(seen["text"])  # 2 N · sin(π 11/24)
    assert str(seen["next"]).startswith("1.04") and str(seen["home"]).startswith("0.00")
    assert not str(seen["later"]).startswith("0.00") and seen["button"] == "Pause"
    assert seen["forces"] == "false" and seen["overflow"] == 0
    rest, bent, contact = (dict(seen[name]) for name in ("rest", "bent", "contact"))  # type: ignore[call-overload]
    states = np.load(run / "states.npz")
    strain = nodal_strain(states["rest_nodes_m"], states["tets"], states["nodes_m"])
    assert rest["mode"] == bent["mode"] == 2 and rest["field"] == 0 and contact["mode"] == 3
    assert bent["field"] == pytest.approx(255 * strain[6].max() / strain.max(), abs=1)
    assert bent["said"] == f"{100 * strain.max():.2f} % strain"
    (touch,) = view.contacts_of_run(run)["frames"][6]["contacts"]
    assert contact["place"][:3] == pytest.approx(in_gltf(np.array(touch["point_m"])), abs=1e-6) and contact["place"][3] > 0
    assert seen["doubtful"] == [True, False]  # a frame that is not ok is faded
    covered: list[dict[str, float]] = seen["covered"]  # type: ignore[assignment]
    assert len(covered) == 2 and all(one["under"] <= 0.5 and one["beyond"] == 0 for one in covered)
    assert covered[0]["off"] < 1e-6  # what is framed is where the arrow begins
    panels: list[dict[str, Any]] = seen["panel"]  # type: ignore[assignment]
    assert all(one["said"] == (one["below"] > 6) for one in panels) and panels[2]["said"]
    for name in ("desk.png", "phone.png"):
        red, green, blue = np.moveaxis(pixels(tmp_path / name).astype(int), -1, 0)
        assert ((blue > 120) & (blue > red + 50)).mean() > 0.005  # the blue body
        if name == "desk.png":
            assert ((red > 180) & (red > blue + 60) & (green > 100)).mean() > 0.0005  # the amber arrow


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_page_says_what_is_missing(request: pytest.FixtureRequest, run: Path, built_page: Path, tmp_path: Path) -> None:
    with view.serve(run, open_browser=False, page=built_page) as server:
        del server.files["robot.glb"]
        seen = look(request, server.url, tmp_path)
    assert seen["state"] == "error" and "robot.glb could not be loaded (404)" in str(seen["text"])
