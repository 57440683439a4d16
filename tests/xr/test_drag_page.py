"""A point of the twin is dragged in a browser: what the page shows, what it sends, and when it stops sending."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
from browser import CHROMIUM, go_on, said, start_browser
from live_bars import Source
from xr_bar import write_run_with_mesh

from femsense.xr.stream.hub import Message
from femsense.xr.stream.run_source import open_run

pytest.importorskip("websockets")

DRAG = """
const page = await opened.newPage({ viewport: { width: 390, height: 844 } });
const say = (what) => console.log(JSON.stringify(what));
const told = () => new Promise((done) => process.stdin.once('data', done));
const boxes = () => page.evaluate(() => {
  const { stage, robots } = femsense.shown, { body } = robots.get('bar'), canvas = document.querySelector('#view').getBoundingClientRect();
  const ball = [];
  body.group.traverse((one) => one.name === 'top' && one.isMesh && ball.push(one));
  const at = ball[0].getWorldPosition(ball[0].position.clone()).project(stage.camera);
  const sides = (id) => { const box = document.querySelector(id).getBoundingClientRect(); return [box.top, box.bottom]; };
  return { ball: [canvas.left + (at.x + 1) / 2 * canvas.width, canvas.top + (1 - at.y) / 2 * canvas.height],
    panel: sides('#panel'), dragging: sides('#dragging'), dock: sides('#dock'), reach: document.querySelector('#reach').textContent };
});
const on = (id) => page.evaluate((id) => document.querySelector(id).getAttribute('aria-pressed'), id);
await page.goto(given[0]);
await page.waitForFunction(() => femsense.shown.robots.get('bar')?.shown && femsense.shown.robots.get('bar').reach, null, { timeout: 60000 });
await page.click('#drag');
await page.waitForTimeout(500);
const begun = await boxes();
const grab = async () => {
  const { ball: [x, y] } = await boxes();
  await page.mouse.move(x, y);
  await page.mouse.down();
  await page.mouse.move(x + 20, y + 5, { steps: 3 });
};
await grab();
await page.waitForFunction(() => document.querySelector('#reach').textContent.startsWith('reached'), null, { timeout: 60000 });
say({ ...begun, answered: (await boxes()).reach, armed: await on('#arm') });
await told();
await page.mouse.up();
await page.click('#arm');
say({ armed: await on('#arm') });
await told();
await grab();
await page.waitForTimeout(400);
await page.evaluate(() => femsense.shown.stage.renderer.setAnimationLoop(null));   // no picture comes any more
say({ held: true });
await told();
await page.mouse.up();
await page.click('#drag');
await page.waitForTimeout(300);
say({ armed: await on('#arm') });
await opened.close();
"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_a_point_is_dragged_on_a_phone_and_wishes_go_on_without_pictures_for_a_second_and_no_longer(
    request: pytest.FixtureRequest, built_page: Path, tmp_path: Path
) -> None:
    source = Source(open_run(write_run_with_mesh(tmp_path / "bar")), built_page, still=True, commands=True)
    before = {"status": "nearest", "text": "an answer to somebody else", "error_m": 0.1, "inputs": []}
    source.hub.publish([Message("femsense/bar/reach", json.dumps(before).encode())])
    browser = start_browser(request.config, DRAG, source.server.url)

    try:
        seen = said(browser)
        assert seen["reach"].startswith("Drag a green point") and seen["answered"].startswith("reached")
        assert seen["panel"][1] < seen["ball"][1] < seen["dragging"][0]  # the point is not covered
        assert seen["dragging"][1] <= seen["dock"][0] and seen["armed"] == "false"
        assert source.wishes and not any(wish["armed"] for wish in source.wishes)
        go_on(browser)
        assert said(browser) == {"armed": "true"} and not source.wishes[-1]["held"]
        go_on(browser)
        assert said(browser)["held"] and source.wishes[-1]["armed"] and source.wishes[-1]["handle"] == "top"
        count = len(source.wishes)
        time.sleep(0.5)
        assert len(source.wishes) > count + 3  # a slow picture does not stop the robot
        time.sleep(1.5)
        count = len(source.wishes)
        time.sleep(0.5)
        assert len(source.wishes) == count  # who sees nothing leads nobody
        go_on(browser)
        assert said(browser) == {"armed": "false"} and not source.wishes[-1]["held"] and not source.wishes[-1]["armed"]
    finally:
        source.close()
        browser.kill()


FINGER = """
const phone = await opened.newContext({ viewport: { width: 390, height: 844 }, hasTouch: true, isMobile: true });
const page = await phone.newPage(), touch = await phone.newCDPSession(page);
const say = (what) => console.log(JSON.stringify(what));
await page.goto(given[0]);
await page.waitForFunction(() => femsense.shown.robots.get('bar')?.shown, null, { timeout: 60000 });
await page.tap('#drag');
await page.waitForTimeout(500);
const hint = await page.textContent('#reach');
const point = () => page.evaluate(() => {
  const { stage, robots } = femsense.shown, { body } = robots.get('bar'), ball = [];
  body.group.traverse((one) => one.name === 'top' && one.isMesh && ball.push(one));
  const at = ball[0].getWorldPosition(ball[0].position.clone()).project(stage.camera);
  return [(at.x + 1) / 2 * innerWidth, (1 - at.y) / 2 * innerHeight];
});
const put = (type, ...at) => touch.send('Input.dispatchTouchEvent', { type, touchPoints: at.map(([x, y]) => ({ x, y })) });
const drag = async (right, down) => {
  const [x, y] = (await point()).map((at, i) => at + [right, down][i]);
  await put('touchStart', [x, y]);
  for (let i = 1; i < 6; i += 1) await put('touchMove', [x + 5 * i, y + i]);
  await page.waitForTimeout(300);
  await put('touchEnd');
  await page.waitForTimeout(200);
};
await drag(60, 0);
say({ hint });
await new Promise((done) => process.stdin.once('data', done));
await drag(18, 10);
say({ dragged: true });
await opened.close();
"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_a_finger_that_covers_a_point_takes_it(request: pytest.FixtureRequest, built_page: Path, tmp_path: Path) -> None:
    source = Source(open_run(write_run_with_mesh(tmp_path / "bar")), built_page, still=True, commands=True)
    browser = start_browser(request.config, FINGER, source.server.url)
    try:
        assert "Shift" not in said(browser)["hint"] and not source.wishes  # beside it the view turns
        go_on(browser)
        assert said(browser)["dragged"]
        held = [wish for wish in source.wishes if wish["held"]]
        assert held and {wish["handle"] for wish in held} == {"top"} and not source.wishes[-1]["held"]
    finally:
        source.close()
        browser.kill()


NAMED = """
const page = await opened.newPage();
await page.goto(given[0]);
await page.waitForFunction(() => femsense.shown.robots.get('bar')?.shown, null, { timeout: 60000 });
const found = [];
for (const [width, height] of [[390, 844], [844, 390], [1280, 760]]) {
  await page.setViewportSize({ width, height });
  await page.waitForFunction((width) => innerWidth === width, width);
  for (let i = 0; i < 3; i++) await page.evaluate(() => new Promise((done) => requestAnimationFrame(done)));
  found.push(await page.evaluate(() => {
    const box = (id) => document.querySelector(id).getBoundingClientRect();
    const at = (of) => document.elementFromPoint((of.left + of.right) / 2, (of.top + of.bottom) / 2)?.id;
    const [title, panel] = [document.querySelector('.title').getBoundingClientRect(), box('#panel')];
    return { stop: at(box('#stop')), apart: panel.top >= title.bottom || panel.left >= title.right, panel: panel.height };
  }));
}
console.log(JSON.stringify(found));
await opened.close();
"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_a_long_name_leaves_the_stop_button_and_the_panel_where_they_are(
    request: pytest.FixtureRequest, built_page: Path, tmp_path: Path
) -> None:
    source = Source(open_run(write_run_with_mesh(tmp_path / "bar")), built_page, still=True, commands=True)
    model = source.hub.newest()["femsense/bar/model"].payload
    long = json.dumps({**json.loads(model), "name": "four-leg-with-friction-on-north-and-south-2026-11-28-evening"})
    source.hub.publish([Message("femsense/bar/model", long.encode())])
    browser = start_browser(request.config, NAMED, source.server.url)
    try:
        found = said(browser)
    finally:
        source.close()
        browser.kill()
    assert [one["stop"] for one in found] == ["stop"] * 3 and all(one["apart"] and one["panel"] > 50 for one in found)
