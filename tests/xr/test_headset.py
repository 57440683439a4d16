"""The page in an emulated headset: enters VR and AR, stands where a surface was hit,
is carried and dragged by controllers and hands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import CHROMIUM, start_browser
from glb import npm_folder
from live_bars import Source
from xr_bar import write_run_with_mesh

from femsense.xr.stream.run_source import open_run
from femsense.xr.view import serve

pytest.importorskip("websockets")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")

ROOM = """
const [url, iwer, shots] = given;
const page = await opened.newPage({ viewport: { width: 320, height: 200 } });
const problems = [];
page.on('pageerror', (e) => problems.push(e.message));
page.on('console', (m) => { if (m.type() === 'error') problems.push(m.text()); });
await page.addInitScript({ path: iwer });
await page.addInitScript(() => {
  class Room { // a table, 0.72 m high, as the device's own sight of the room
    constructor() {
      this.trackedPlanes = new Set();
      this.trackedMeshes = new Set();
      this.environmentCanvas = document.createElement('canvas');
    }
    render() {}
    computeHitTestResults(ray) {
      const [x, y, z] = [ray[12], ray[13], ray[14]], [dx, dy, dz] = [-ray[8], -ray[9], -ray[10]];
      const t = (0.72 - y) / dy;
      return t > 0 ? [[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x + t * dx, 0.72, z + t * dz, 1]] : [];
    }
  }
  const device = new IWER.XRDevice(IWER.metaQuest3);
  device.installRuntime({ forceInstall: true });
  device.installSEM(Room);
  device.position.set(0, 1.6, 0);
  globalThis.device = device;
});
await page.goto(url);
await page.waitForFunction(() => {
  const shown = globalThis.femsense?.shown;
  return shown && (!shown.robots || shown.robots.get('bar')?.shown); // a stream's robots, or a run
}, null, { timeout: 60000 });
const frames = (n = 2) => page.evaluate((n) => new Promise((done) => {
  const next = () => (n-- > 0 ? (femsense.stage.renderer.xr.getSession() ?? globalThis).requestAnimationFrame(next) : done());
  next();
}), n);
const look = () => page.evaluate(() => {
  const { stage, shown } = femsense, robot = stage.robot, body = shown.robots.get('bar').body;
  robot.updateWorldMatrix(true, true);
  return {
    presenting: stage.renderer.xr.isPresenting, mode: document.documentElement.dataset.xr ?? '',
    position: robot.position.toArray(), turn: robot.quaternion.toArray(), scale: robot.scale.toArray(),
    lowest: stage.headset.box.min.y, middle: stage.headset.box.getCenter(robot.position.clone()).toArray(),
    reticle: stage.headset.reticle.visible, drag: !document.querySelector('#dragging').hidden,
    ball: body.group.children.find((c) => c.name === 'top').getWorldPosition(robot.position.clone()).toArray(),
    wish: femsense.shown.dragging.wish.toArray(),
  };
});
const put = (who, x, y, z, q = [0, 0, 0, 1]) => page.evaluate(([who, x, y, z, q]) => {
  const hand = who === 'device' ? device : who === 'hand' ? device.hands.right : device.controllers.right;
  hand.position.set(x, y, z);
  hand.quaternion.set(...q);
}, [who, x, y, z, q]);
const press = (id, value) => page.evaluate(([id, v]) => device.controllers.right.updateButtonValue(id, v), [id, value]);
const enter = async (id) => {
  await page.waitForFunction((id) => !document.querySelector(id).hidden, id);
  await page.evaluate((id) => document.querySelector(id).click(), id);
  await page.waitForFunction(() => femsense.stage.renderer.xr.isPresenting);
  await frames();
};
const leave = async () => {
  await page.evaluate(() => femsense.stage.renderer.xr.getSession().end());
  await page.waitForFunction(() => !femsense.stage.renderer.xr.isPresenting);
  await frames();
};
const end = async (result) => {
  console.log(JSON.stringify({ ...result, problems }));
  await opened.close();
};
"""

CARRY_AND_DRAG = """
const before = await look();
await enter('#enter-vr');
const vr = await look();
await page.screenshot({ path: shots + '/vr.png' });
const [x, y, z] = vr.ball;
await put('controller', x, y, z + 0.4);                      // points along -z at the handle
await frames();
await press('trigger', 1);
await frames();
await put('controller', x + 0.05, y + 0.02, z + 0.4);
await frames(4);
const pulled = await look();
await press('trigger', 0);
await frames();
await put('controller', x, y - 0.12, z + 0.4);               // at the body, below the handle
await frames();
await press('squeeze', 1);
await frames();
await put('controller', x - 0.1, y - 0.12 + 0.3, z + 0.4);
await frames();
await press('squeeze', 0);
await frames();
const carried = await look();
await put('controller', 5, 5, 5);
await frames();
await page.evaluate(() => { device.primaryInputMode = 'hand'; });
await frames();
const at = (await look()).ball;
const tip = () => page.evaluate(() => {
  const { xr } = femsense.stage.renderer;
  const right = [...xr.getSession().inputSources].findIndex((source) => source.handedness === 'right');
  const place = femsense.stage.robot.position.clone();
  return ['index-finger-tip', 'thumb-tip'].map((n) => xr.getHand(right).joints[n].getWorldPosition(place).toArray());
});
await put('hand', at[0], at[1], at[2]);
await frames();
const [finger, thumb] = await tip();
const off = at.map((v, i) => v - 0.5 * (finger[i] + thumb[i]));
await put('hand', at[0] + off[0], at[1] + off[1], at[2] + off[2]);
await frames();
await page.evaluate(() => device.hands.right.updatePinchValue(1));
await frames();
const pinched = await look();
await put('hand', at[0] + off[0], at[1] + off[1] - 0.04, at[2] + off[2]);
await frames(4);
const drawn = await look();
await page.evaluate(() => device.hands.right.updatePinchValue(0));
await frames();
await leave();
const after = await look();
await page.screenshot({ path: shots + '/after.png' });
await end({ before, vr, pulled, carried, at, pinched, drawn, after });
"""

BOTH_HANDS = """
await enter('#enter-vr');
const trigger = (which, value) => page.evaluate(([w, v]) => device.controllers[w].updateButtonValue('trigger', v), [which, value]);
const words = () => page.evaluate(() => femsense.stage.headset.words.text);
const [x, y, z] = (await look()).ball, said = [];
await put('controller', x, y, z + 0.4);
await page.evaluate(() => device.controllers.left.position.set(-0.4, 1.0, 0.3));
for (const [which, value] of [['right', 1], ['left', 1], ['left', 0], ['left', 1], ['right', 0], ['left', 0]]) {
  await frames();
  await trigger(which, value);
  await frames(6);
  said.push(await words());
}
await leave();
await end({ said });
"""

PLACE_AND_ALIGN = """
const half = Math.SQRT1_2;
await put('device', 0, 1.6, 0, [-Math.sin(0.4), 0, 0, Math.cos(0.4)]);   // looks down at the table
await put('controller', 0.4, 1.2, 0);
await enter('#enter-ar');
await frames();
const waiting = await look();
const ring = await page.evaluate(() => femsense.stage.headset.reticle.matrix.toArray().slice(12, 15));
await page.screenshot({ path: shots + '/ar.png' });
await press('trigger', 1);
await frames();
await press('trigger', 0);
await frames(4);
const placed = await look();
const anchored = await page.evaluate(() => femsense.stage.headset.anchor !== null);
await leave();
await page.evaluate(() => document.querySelector('#align').click());
await enter('#enter-ar');
const asked = [];
const true_ = [[0.3, 0.9, -0.4], [0, half, 0, half]];                    // where the real robot stands: turned by 90° about the vertical
const landmarks = await page.evaluate(() => femsense.stage.headset.alignment.landmarks.map((l) => l.place().toArray()));
for (const [a, b, c] of landmarks) {
  asked.push(await page.evaluate(() => femsense.stage.headset.words.text));
  await put('controller', true_[0][0] + c, true_[0][1] + b, true_[0][2] - a);
  await frames();
  await press('trigger', 1);
  await frames();
  await press('trigger', 0);
  await frames();
}
const aligned = await look();
const said = await page.evaluate(() => femsense.stage.headset.words.text);
await leave();
await end({ waiting, ring, placed, anchored, asked, aligned, said, after: await look() });
"""

OUT_OF_SIGHT = """
await page.evaluate(() => {
  const watch = new MutationObserver((found) => (globalThis.written += found.length));
  for (const id of ['panel', 'dock']) watch.observe(document.getElementById(id), { childList: true, subtree: true, characterData: true });
});
const written = () => page.waitForFunction(() => globalThis.written > 0, null, { timeout: 60000 });
const none = () => page.evaluate(() => (globalThis.written = 0));
await none();
await written();
await enter('#enter-vr');
await none();
const begun = Date.now();
while (Date.now() < begun + 1000) await frames(4);
const within = await page.evaluate(() => globalThis.written);
await leave();
await none();
await written();
await end({ within });
"""

CLOCK = """
const clock = () => page.evaluate(() => [femsense.shown.time.toFixed(2), document.querySelector('#clock strong').textContent]);
await page.evaluate(() => { femsense.shown.play(false); femsense.shown.seek(0); });
await enter('#enter-vr');
await page.evaluate(() => femsense.shown.seek(0.25));
await frames();
const within = await clock();
await leave();
await end({ within, after: await clock() });
"""


def in_the_room(
    request: pytest.FixtureRequest, page: Path, tmp_path: Path, script: str, *, commands: bool = False
) -> tuple[dict[str, Any], Source]:
    """What a script finds in an emulated headset beside two bars that stream."""
    source = Source(open_run(write_run_with_mesh(tmp_path / "bar")), page, still=True, commands=commands)
    try:
        return through_a_headset(request, source.server.url, tmp_path, script), source
    finally:
        source.close()


def through_a_headset(request: pytest.FixtureRequest, url: str, tmp_path: Path, script: str) -> dict[str, Any]:
    """What a script finds in a page in an emulated headset."""
    iwer = npm_folder(request.config.cache.mkdir("iwer"), "iwer@2.5.0") / "node_modules" / "iwer" / "build" / "iwer.min.js"
    browser = start_browser(request.config, ROOM + script, url, str(iwer), str(tmp_path))
    out, errors = browser.communicate(timeout=300)
    assert browser.returncode == 0, errors
    found: dict[str, Any] = json.loads(out.splitlines()[-1])
    assert found["problems"] == []
    return found


def test_a_headset_enters_drags_carries_and_leaves(request: pytest.FixtureRequest, built_page: Path, tmp_path: Path) -> None:
    seen, source = in_the_room(request, built_page, tmp_path, CARRY_AND_DRAG)
    vr = seen["vr"]
    assert vr["presenting"] and vr["mode"] == "immersive-vr" and vr["drag"] and vr["scale"] == pytest.approx([1, 1, 1])
    assert vr["position"][1] + vr["lowest"] == pytest.approx(1.1) and -1.0 < vr["position"][2] < -0.3  # on a table in front
    np.testing.assert_allclose(np.subtract(seen["pulled"]["wish"], vr["ball"]), [0.05, 0.02, 0.0], atol=1e-3)
    np.testing.assert_allclose(seen["pulled"]["position"], vr["position"], atol=1e-9)
    np.testing.assert_allclose(np.subtract(seen["carried"]["position"], vr["position"]), [-0.1, 0.3, 0.0], atol=1e-6)
    np.testing.assert_allclose(np.subtract(seen["drawn"]["wish"], seen["pinched"]["wish"]), [0.0, -0.04, 0.0], atol=2e-3)
    np.testing.assert_allclose(seen["pinched"]["wish"], seen["at"], atol=1e-3)
    after = seen["after"]
    assert not after["presenting"] and after["position"] == [0, 0, 0] and not after["drag"] and after["mode"] == ""
    held = [wish for wish in source.wishes if wish["held"]]
    assert held and {wish["handle"] for wish in held} == {"top"} and not source.wishes[-1]["held"]
    moves = np.array([[wish["target_m"][axis] for axis in "xyz"] for wish in held])
    assert np.ptp(moves[:, 0]) == pytest.approx(0.05, abs=2e-3)  # x of the room is the robot's


def test_the_robot_follows_one_hand_while_the_other_is_closed_too(
    request: pytest.FixtureRequest, built_page: Path, tmp_path: Path
) -> None:
    seen, source = in_the_room(request, built_page, tmp_path, BOTH_HANDS, commands=True)
    one, both = "close your other hand too, and the robot follows", "the robot follows"
    assert seen["said"] == [one, both, one, both, "", ""]
    held = [wish["armed"] for wish in source.wishes if wish["held"]]
    turns = [now for before, now in zip([None, *held], held) if before != now]
    assert turns == [False, True, False, True] and not source.wishes[-1]["held"] and not source.wishes[-1]["armed"]


def test_a_page_that_nobody_sees_is_not_written(request: pytest.FixtureRequest, built_page: Path, tmp_path: Path) -> None:
    seen, _ = in_the_room(request, built_page, tmp_path, OUT_OF_SIGHT)
    assert seen["within"] == 0


def test_the_clock_of_a_run_is_right_again_after_a_headset(
    request: pytest.FixtureRequest, built_page: Path, tmp_path: Path
) -> None:
    with serve(write_run_with_mesh(tmp_path / "bar"), open_browser=False, page=built_page) as server:
        seen = through_a_headset(request, server.url, tmp_path, CLOCK)
    assert seen["within"] == ["0.25", "0.00"] and seen["after"] == ["0.25", "0.25"]


def test_in_ar_a_hit_surface_carries_the_robot_and_touched_markers_lay_it_over_the_real_one(
    request: pytest.FixtureRequest, built_page: Path, tmp_path: Path
) -> None:
    seen, _ = in_the_room(request, built_page, tmp_path, PLACE_AND_ALIGN)
    waiting, placed = seen["waiting"], seen["placed"]
    assert waiting["mode"] == "immersive-ar" and waiting["reticle"] and seen["ring"][1] == pytest.approx(0.72)
    foot = np.add(placed["position"], [placed["middle"][0], placed["lowest"], placed["middle"][2]])
    np.testing.assert_allclose(foot, seen["ring"], atol=1e-3)
    assert seen["anchored"]
    assert "touch" in seen["asked"][0] and "(1 of 3)" in seen["asked"][0] and "the camera" in seen["asked"][2]
    np.testing.assert_allclose(seen["aligned"]["position"], [0.3, 0.9, -0.4], atol=1e-3)
    np.testing.assert_allclose(np.abs(seen["aligned"]["turn"]), np.abs([0, np.sqrt(0.5), 0, np.sqrt(0.5)]), atol=1e-3)
    assert "aligned: 0.0 mm" in seen["said"] and not seen["after"]["presenting"]
