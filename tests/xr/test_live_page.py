"""The page of a stream in a browser: what comes is shown where it is, what stops is grey within half a second, and comes back."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest
from browser import CHROMIUM, go_on, run_in_browser, said, start_browser
from live_bars import Source
from streams import read_frame, within
from xr_bar import write_run_with_mesh

from femsense.app.stream_command import show_stream
from femsense.xr.stream.access import Access
from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.payloads import TwinFrame, pose_bytes, status_bytes
from femsense.xr.stream.publisher import Publisher, PublishOptions
from femsense.xr.stream.run_source import RunStream, frames_of, open_run
from femsense.xr.stream.websocket import ServerOptions, WebSocketServer
from femsense.xr.view import live_page_files

pytest.importorskip("websockets")

WATCH = """
const [url, shot] = given;
const page = await opened.newPage({ viewport: { width: 700, height: 500 } });
const problems = [], hosts = new Set();
page.on('pageerror', (e) => problems.push(e.message));
page.on('request', (r) => { if (r.url().startsWith('http')) hosts.add(new URL(r.url()).host); });
const say = (what) => console.log(JSON.stringify(what));
const told = () => new Promise((done) => process.stdin.once('data', done));
const stream = (state) => page.waitForFunction((s) => document.documentElement.dataset.stream === s, state, { timeout: 60000 });
await page.goto(url);
await stream('live');
await page.waitForFunction(() => {
  const robots = [...femsense.shown.robots.values()];
  return robots.length === 2 && robots.every((r) => r.body && r.shown);
}, null, { timeout: 60000 });
const live = await page.waitForFunction(  // both in one picture: forces come and go
  () => document.querySelector('#sum').textContent.includes('±') && document.querySelector('#badge').textContent.startsWith('live')
    && document.body.innerText, null, { timeout: 60000 });
say({ text: await live.jsonValue(), clock: await page.textContent('#clock'), meters: await page.locator('[role=meter]').count() });
await told();
await page.waitForFunction(() => femsense.shown.robots.get('bar').shown?.frame === 999, null, { timeout: 60000 });
await page.selectOption('#paint', 'stress');
await page.waitForTimeout(300);                                // fields come ten times a second
await page.waitForFunction(() => document.querySelector('#scale-top').textContent.includes('strain'));
say(await page.evaluate(() => {
  const { body, shown } = femsense.shown.robots.get('bar');
  body.gltf.scene.updateMatrixWorld(true);
  const skin = body.skins[0], at = skin.position.clone();
  const vertices = [0, 50, 200].map((i) => skin.getVertexPosition(i, at).toArray());
  const arrow = body.arrows.group.children[0];
  return { vertices, arrow: arrow.getWorldPosition(at).toArray(), cone: arrow.children[3].visible, bones: Array.from(shown.bones),
    field: Array.from(skin.geometry.getAttribute('paintField').array), mode: body.painter.mode.value, scale: document.querySelector('#scale-top').textContent };
}));
await told();
await page.waitForFunction(() => femsense.shown.robots.get('bar').shown?.frame === 1000, null, { timeout: 60000 });
await page.waitForTimeout(1000);
await page.screenshot({ path: shot.replace('stale', 'far') });
say(await page.evaluate(() => [...femsense.shown.robots.values()].flatMap(({ body, shown }) => {
  const box = body.extent(shown.contacts).translate(body.group.position), corner = box.min.clone();
  return [0, 1, 2, 3, 4, 5, 6, 7].map((i) => corner
    .set(box[i & 1 ? 'max' : 'min'].x, box[i & 2 ? 'max' : 'min'].y, box[i & 4 ? 'max' : 'min'].z)
    .project(femsense.shown.stage.camera).toArray());
})));
await told();
await page.waitForFunction(() => femsense.shown.robots.get('bar').body.isDoubtful, null, { timeout: 60000 });
await page.waitForTimeout(300);
say(await page.evaluate(() => ({
  faded: femsense.shown.robots.get('bar').body.painter.faded.value,
  badge: document.querySelector('#badge').dataset.state,
  parts: ['#sum', '#plot', '#forces', '#frame-facts'].map((id) => document.querySelector(id).checkVisibility()),
})));
await page.evaluate(() => new Promise((done) => {
  let last = performance.now();
  const { take } = femsense.shown.robots.get('bar').constructor.prototype;
  femsense.shown.robots.get('bar').constructor.prototype.take = function (...a) {
    if (this.id === 'bar') last = performance.now();
    return take.apply(this, a);
  };
  const look = () => {
    if (femsense.shown.robots.get('bar').body.isStale) { globalThis.greyAfter = performance.now() - last; return; }
    setTimeout(look, 5);
  };
  look();
  done();
}));
await page.evaluate(() => {
  const proto = femsense.shown.robots.get('bar').constructor.prototype, step = proto.step;
  globalThis.pictures = [];
  proto.step = function (now, ...more) {
    step.call(this, now, ...more);
    if (this.id === 'bar') pictures.push([(now - this.arrived) / 1000, this.body.isStale]);
  };
});
say({ watching: true });
await stream('stale');
await page.waitForFunction(() => globalThis.greyAfter !== undefined);
await page.screenshot({ path: shot });
say({
  grey: await page.evaluate(() => globalThis.greyAfter),
  pictures: await page.evaluate(() => globalThis.pictures),
  badge: await page.textContent('#badge'),
});
await stream('live');
const fresh = await page.evaluate(() => !femsense.shown.robots.get('bar').body.isStale);
await page.keyboard.press(' ');
await page.waitForFunction(() => document.querySelector('#badge').textContent.startsWith('paused'));
await page.keyboard.press('ArrowLeft');
await page.keyboard.press('End');
await page.keyboard.press('d');
await page.waitForFunction(() => !document.querySelector('#dragging').hidden);
await page.keyboard.press('Shift+ArrowRight');
await page.waitForFunction(() => document.querySelector('#reach').textContent.includes('reached'), null, { timeout: 60000 });
await page.setViewportSize({ width: 360, height: 740 });
await page.waitForTimeout(200);
const overflow = await page.evaluate(() => document.documentElement.scrollWidth - window.innerWidth);
say({ fresh, overflow, problems, hosts: [...hosts] });
await opened.close();
"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_what_streams_is_shown_where_it_is_and_greys_when_it_stops(
    request: pytest.FixtureRequest, built_page: Path, tmp_path: Path
) -> None:
    run = open_run(write_run_with_mesh(tmp_path / "bar"))
    source = Source(run, built_page)
    browser = start_browser(request.config, WATCH, source.server.url, str(tmp_path / "stale.png"))

    try:
        seen = said(browser)
        assert "Track 0" in seen["text"] and "bar-2" in seen["text"] and "live" in seen["text"]
        within, length = (float(word) for word in seen["clock"].removesuffix(" s").split(" / "))
        assert length == 2.0 and 0.0 <= within <= length  # though it plays over and over
        frame = list(frames_of(run, rate_hz=23 / 2.0, loop=False))[11]
        unsure = replace(frame.contacts[0], force_std_n=np.array([0.1, 0.4, 0.4]))
        source.last = replace(frame, frame=999, contacts=(unsure,))
        go_on(browser)
        scene = said(browser)
        check_scene(scene, run, source.last)
        assert scene["field"] == run.field[11].tolist() and scene["mode"] == 2 and scene["scale"].endswith("% strain")
        away = frame.bones + np.array([0.0, 0.15, 0.25, 0, 0, 0, 0])
        source.last = replace(source.last, frame=1000, bones=away)
        go_on(browser)
        corners = np.array(said(browser))
        assert np.abs(corners[:, :2]).max() < 1.0  # all of it is still in the picture
        assert np.abs(corners[:, 1]).max() > 0.1
        source.last = replace(source.last, contacts=None, status="light = 9 is outside 0 … 1")
        go_on(browser)
        odd = said(browser)
        assert (
            0 < odd["faded"] < 1
            and odd["badge"] == "doubtful"
            and odd["parts"]
            == [
                False,
                False,
                False,
                True,
            ]
        )  # no forces are known; why it is faded is said
        assert said(browser)["watching"]
        source.flowing.clear()
        stale = said(browser)
        assert stale["grey"] < 900 and "stale" in stale["badge"]  # 0.4 s and a slow picture; the machine may be busy
        assert all(grey == (age > 0.4) for age, grey in stale["pictures"])  # each picture after 0.4 s is grey, none before
        assert any(grey for _, grey in stale["pictures"])
        source.flowing.set()
        end = said(browser)
        assert end["fresh"] and end["overflow"] == 0 and end["problems"] == []
        assert end["hosts"] == [source.server.url.split("/")[2]]
        held = [wish for wish in source.wishes if wish["held"]]
        assert held and held[0]["handle"] == "top" and not held[0]["armed"] and not source.wishes[-1]["held"]
    finally:
        source.close()
        browser.kill()


LATE = """
const page = await opened.newPage({ viewport: { width: 700, height: 500 } });
await page.goto(given[0]);
await page.waitForFunction(() => femsense.shown.robots.get('bar')?.body?.isStale, null, { timeout: 60000 });
await page.waitForFunction(() => document.querySelector('#about').textContent.includes('reconnect'), null, { timeout: 20000 }).catch(() => undefined);
const [early, about] = [await page.textContent('#badge'), await page.textContent('#about')];
const forces = () => page.evaluate(() => ['#sum', '#plot', '#contacts', '#curve', '#forces'].map((id) => document.querySelector(id).checkVisibility()));
const spoken = await forces();
await page.click('#robots button:has-text("mute")');
await page.waitForFunction(() => femsense.shown.robots.get('mute').shown);
await page.waitForFunction(() => !document.querySelector('#sum').checkVisibility(), null, { timeout: 20000 }).catch(() => undefined);
const unspoken = await forces();
console.log(JSON.stringify({ badge: early, about, spoken, unspoken, state: await page.evaluate(() => document.documentElement.dataset.stream),
  live: await page.evaluate(() => femsense.shown.robots.get('bar-2').told.state),
  rate: await page.evaluate(async (bytes) => {                 // a page that is busy takes few poses: one of ten here, every 100 ms
    const robot = femsense.shown.robots.get('bar-2'), pose = new Uint8Array(bytes), head = new DataView(pose.buffer);
    for (let seq = 100000; seq < 100100; seq += 10) {
      head.setUint32(4, seq, true);
      robot.take('pose', pose);
      await new Promise((done) => setTimeout(done, 100));
    }
    return robot.state(performance.now(), '')[1];
  }, JSON.parse(given[1])),
  late: await page.evaluate(() => {                            // what waited while the page was busy comes all at once
    const pace = new (femsense.shown.robots.get('bar-2').pace.constructor)();
    for (let ms = 0, seq = 0; ms < 1500; ms += 1000 / 60, seq += 1) {
      if (ms > 500) pace.take(ms, seq);
      if (Math.floor(ms / 100) > Math.floor((ms - 1000 / 60) / 100)) pace.count(ms);
    }
    const even = pace.hz(), busy = new pace.constructor();
    for (let k = 0; k < 90; k++) busy.take(1000 + 0.3 * k, k);    // a second and a half of poses, taken in 30 ms, with a count amid
    for (let k = 0; k < 90; k++) {
      if (k === 0) busy.count(1010);
      busy.take(1030 + k * 1000 / 60, 90 + k);
      if (k % 6 === 0) busy.count(1030 + k * 1000 / 60);
    }
    return [even, busy.hz()];
  }),
  times: await page.evaluate(() => {
    const robot = femsense.shown.robots.get('mute');
    const clock = (time) => {
      robot.newest = { ...robot.newest, time_s: time };
      robot.history.length = 0;
      robot.shown = robot.newest;
      femsense.shown.read(performance.now());
      return document.querySelector('#clock').textContent;
    };
    const day = new Date();
    return [12.34, 86938.2, 125, day.getTime() / 1000].map(clock).concat(day.toLocaleTimeString());
  }),
  gaps: await page.evaluate(() => {                            // nothing came for three seconds
    const robot = femsense.shown.robots.get('mute'), first = robot.history[0] ?? robot.newest;
    robot.history.splice(0, robot.history.length, ...[...Array(41).keys()].filter((k) => k < 11 || k > 30).map((k) => ({ ...first, time_s: 0.1 * k })));
    femsense.shown.timeline(robot, 4, 4);
    return [...document.querySelectorAll('#curve .edge')].map((path) => path.getAttribute('d').slice(1).split('L').map((xy) => Number(xy.split(',')[0])));
  }),
  edges: await page.evaluate(async () => {                     // the picture is pushed aside until the label would be cut
    const { stage, robots } = femsense.shown, { body } = robots.get('bar'), { camera } = stage;
    const arrow = body.arrows.arrows[0], { sprite, canvas } = arrow.label, found = [];
    for (const aside of [-600, 600]) {
      camera.setViewOffset(700, 500, aside, 0, 700, 500);
      camera.updateProjectionMatrix();
      body.arrows.face(camera, stage.pixelHeight, stage.room);
      const pen = canvas.getContext('2d'), written = pen.getImageData(0, canvas.height / 2, canvas.width, 1).data;
      const shown = [...Array(canvas.width).keys()].filter((i) => written[4 * i + 3] > 0);
      const parent = sprite.parent.getWorldScale(camera.position.clone()).x;
      for (const i of [shown[0], shown[shown.length - 1]]) {
        const corner = sprite.getWorldPosition(camera.position.clone()).applyMatrix4(camera.matrixWorldInverse);
        corner.x += (i / canvas.width - sprite.center.x) * sprite.scale.x * parent;
        found.push(corner.applyMatrix4(camera.projectionMatrix).x);
      }
    }
    return found;
  }),
  noise: await page.evaluate(() => {                           // the first force that is shown is one that noise may make
    const { arrows } = femsense.shown.robots.get('bar').body;
    const weak = { point_m: [0, 0, 0], force_vector_n: [0, 0, 0.003], force_n: 0.003, std_n: 0.01, force_std_n: null, point_std_m: null };
    arrows.largest = 1e-9;
    arrows.show([weak]);
    return arrows.ends([weak])[0].length() / arrows.size;
  }) }));
await opened.close();
"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_who_comes_late_sees_that_a_stream_has_stopped_the_rate_is_the_source_s_and_no_label_is_cut(
    request: pytest.FixtureRequest, built_page: Path, tmp_path: Path
) -> None:
    run = open_run(write_run_with_mesh(tmp_path / "bar"))
    source = Source(run, built_page, still=True)
    touched = list(frames_of(run, rate_hz=23 / 2.0, loop=False))[11]
    source.last = touched
    try:
        time.sleep(0.2)
        assert within(5.0, lambda: source.publishers[0].sent > 0)
        source.flowing.clear()
        time.sleep(0.2)
        source.hub.publish(
            [
                Message(
                    "femsense/bar/status", status_bytes("stale", "unplugged for 9 s; reconnect the camera", time.time() - 100.0)
                )
            ]
        )
        known = source.hub.newest()
        mute = {kind: known[f"femsense/bar/{kind}"].payload for kind in ("glb", "model", "pose")}
        mute["model"] = mute["model"].replace(b'"name":"bar"', b'"name":"mute"')
        source.hub.publish([Message(f"femsense/mute/{kind}", payload) for kind, payload in mute.items()])
        told = run_in_browser(request.config, LATE, source.server.url, json.dumps(list(pose_bytes(0, 0.0, touched.bones))))
    finally:
        source.close()
    age = float(told["badge"].removeprefix("stale, ").removesuffix(" s old"))
    assert told["about"] == "unplugged for 9 s; reconnect the camera"
    assert [(line[0], line[-1]) for line in told["gaps"]] == [(0.0, 250.0), (775.0, 1000.0)]
    assert told["state"] == "stale" and 100.0 <= age < 200.0 and told["live"] == "live"
    assert 40 < float(told["rate"].removeprefix("live, ").removesuffix(" Hz")) < 110  # what is sent: ten times what arrives
    assert told["late"] == pytest.approx([60.0, 60.0], rel=0.05)
    assert told["times"][:3] == ["12.3 s", "24:08:58", "2:05"] and told["times"][3] == told["times"][4]
    assert all(told["spoken"]) and not any(told["unspoken"])  # nobody speaks of forces of the third robot
    assert told["noise"] == pytest.approx(0.42 * 0.003 / (3 * 0.01))  # no long arrow
    side = 1.0 - 2 * 10 / 700  # a label stays in the picture, ten pixels from its edges
    assert told["edges"][1] == pytest.approx(side, abs=0.01) and told["edges"][2] == pytest.approx(-side, abs=0.01)


WAITS = """
const page = await opened.newPage({ viewport: { width: 700, height: 500 } });
const say = (what) => console.log(JSON.stringify(what));
const told = () => new Promise((done) => process.stdin.once('data', done));
const badge = (state) => page.waitForFunction((s) => document.querySelector('#badge').dataset.state === s, state, { timeout: 60000 });
const seen = () => page.evaluate(() => ({ badge: document.querySelector('#badge').textContent, panel: document.querySelector('#panel').checkVisibility(),
  live: document.querySelector('#live').getAttribute('aria-pressed'), grey: femsense.shown.robots.get('arm').body.isStale }));
await page.goto(given[0]);
await badge('waiting');
await page.waitForFunction(() => femsense.shown.robots.get('arm')?.body?.isStale, null, { timeout: 60000 });
say(await seen());
await badge('live');
await page.waitForTimeout(300);
say(await seen());
await page.keyboard.press(' ');
await badge('paused');
say(await seen());
await page.evaluate(() => {
  const robot = femsense.shown.robots.get('arm'), proto = robot.constructor.prototype, step = proto.step;
  globalThis.pictures = [];
  proto.step = function (now, ...more) {
    step.call(this, now, ...more);
    pictures.push([(now - this.arrived) / 1000, this.body.isStale]);
  };
});
await page.waitForFunction(() => globalThis.pictures.some(([, grey]) => !grey), null, { timeout: 60000 });
say({ watching: true });
await badge('stale');
await page.waitForTimeout(300);
say({ ...await seen(), pictures: await page.evaluate(() => globalThis.pictures) });
await told();
await badge('lost');
say(await seen());
await told();
await badge('ended');
await page.waitForTimeout(600);                                // the connection is closed by now
say(await seen());
await opened.close();
"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_a_page_says_what_it_waits_for_and_greys_what_stops_while_it_is_paused(
    request: pytest.FixtureRequest, built_page: Path, tmp_path: Path
) -> None:
    run, hub = open_run(write_run_with_mesh(tmp_path / "bar")), Hub()
    publisher = Publisher(hub, replace(run.twin, name="arm"), PublishOptions(waits_for="readings of a.csv"))
    server = WebSocketServer(hub, live_page_files(built_page), options=ServerOptions(port=0))
    browser = start_browser(request.config, WAITS, server.url)
    flowing, frames = Event(), frames_of(run, rate_hz=30.0)

    def flow() -> None:
        while not flowing.wait(1 / 30):
            publisher.publish(next(frames))

    try:
        waiting = {"badge": "waiting for readings of a.csv", "panel": False, "live": "false", "grey": True}
        assert said(browser) == waiting
        sender = Thread(target=flow, daemon=True)
        sender.start()
        live = said(browser)
        assert live["badge"].startswith("live") and live["panel"] and live["live"] == "true" and not live["grey"]
        paused = said(browser)
        assert paused["badge"].startswith("paused · live") and paused["live"] == "false" and not paused["grey"]
        assert said(browser)["watching"]
        flowing.set()  # nothing comes any more, the connection stands
        stale = said(browser)
        assert stale["badge"].startswith("paused · stale") and stale["grey"]
        assert all(grey == (age > 0.4) for age, grey in stale["pictures"]) and any(not grey for _, grey in stale["pictures"])
        sender.join()
        go_on(browser)
        hub.close()
        assert said(browser) == {"badge": "paused · no connection", "panel": True, "live": "false", "grey": True}
        go_on(browser)
        again = WebSocketServer(hub, live_page_files(built_page), options=ServerOptions(port=server.port))
        assert within(20.0, lambda: again.viewers == 1)
        publisher.end()
        hub.close()
        assert said(browser) == {"badge": "paused · ended", "panel": True, "live": "false", "grey": True}
    finally:
        flowing.set()
        hub.close()
        browser.kill()


WHY = """
const page = await opened.newPage({ viewport: { width: 390, height: 700 } });
await page.goto(given[0]);
await page.waitForFunction(() => document.querySelector('#about').textContent.includes('password'), null, { timeout: 60000 });
console.log(JSON.stringify({ about: await page.textContent('#about'), badge: await page.textContent('#badge'),
  aside: await page.evaluate(() => document.documentElement.scrollWidth > innerWidth) }));
await opened.close();
"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_a_page_without_a_robot_says_what_keeps_it_from_the_stream(request: pytest.FixtureRequest, built_page: Path) -> None:
    hub = Hub()
    server = WebSocketServer(hub, live_page_files(built_page), access=Access(password="secret"))
    try:
        with show_stream(server.url, page=built_page) as shown:
            told = run_in_browser(request.config, WHY, shown.url)
            where = server.url.rstrip("/")
    finally:
        hub.close()
    assert told["about"].startswith(f"no connection to {where}") and "a password is needed: --password-file FILE" in told["about"]
    assert told["badge"] == "no robot yet" and not told["aside"]


def check_scene(scene: dict[str, Any], run: RunStream, frame: TwinFrame) -> None:
    """Vertices and the arrow stand where the frame puts them, in glTF's frame (Y up)."""
    from glb import in_gltf
    from scipy.spatial.transform import Rotation

    from femsense.xr.skinning import skin_vertices

    T = np.tile(np.eye(4), (len(frame.bones), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(frame.bones[:, 3:]).as_matrix(), frame.bones[:, :3]
    wanted = in_gltf(skin_vertices(run.skin.skin, T[None])[0])[[0, 50, 200]]
    np.testing.assert_allclose(scene["vertices"], wanted, atol=1e-6)
    side = np.array(scene["arrow"]) - in_gltf(frame.contacts[0].point_m)
    assert np.abs(side[1:]).max() < 1e-6 and abs(side[0]) < 0.2  # robots stand side by side along x
    assert scene["cone"]


def test_frames_of_messages_are_what_the_page_takes_apart() -> None:
    from femsense.xr.stream.websocket import pack

    packed = pack([Message("femsense/a/pose", b"12345"), Message("femsense/ä/force", b"{}")])
    assert read_frame(packed) == {"femsense/a/pose": b"12345", "femsense/ä/force": b"{}"}
