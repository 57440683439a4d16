"""A point is dragged in a browser on a page that `stream --drag` serves, and another robot than the model obeys."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread

import numpy as np
import pytest
from browser import CHROMIUM, go_on, said, start_browser
from helpers import block_mesh, write_block_robot, write_small_recording
from obedient import ObedientRobot
from small_run import make_run
from streams import within

import femsense as fs
from femsense.app.stream_command import StreamOptions, let_drag, stream_runs
from femsense.fem.mesh import to_quadratic
from femsense.io.recording_folder import load_recording
from femsense.io.robot_toml import load_robot
from femsense.sensing.run_files import run_inputs, write_run
from femsense.xr.run_contents import export_run
from femsense.xr.stream.bridge import Bridge
from femsense.xr.stream.command_gate import GateOptions
from femsense.xr.stream.drag_server import DragOptions, drive_inputs
from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.websocket import ServerOptions, WebSocketServer
from femsense.xr.view import live_page_files

pytest.importorskip("websockets")

BEGIN = """
const page = await opened.newPage({ viewport: { width: 900, height: 600 } });
const say = (what) => console.log(JSON.stringify(what));
const told = () => new Promise((done) => process.stdin.once('data', done));
const robot = given[1];
const on = (id) => page.evaluate((id) => document.querySelector(id).getAttribute('aria-pressed'), id);
const ball = () => page.evaluate((robot) => {
  const { stage, robots } = femsense.shown, { body } = robots.get(robot), canvas = document.querySelector('#view').getBoundingClientRect();
  const found = [];
  body.group.traverse((one) => one.name === 'tip' && one.isMesh && found.push(one));
  const at = found[0].getWorldPosition(found[0].position.clone()).project(stage.camera);
  return [canvas.left + (at.x + 1) / 2 * canvas.width, canvas.top + (1 - at.y) / 2 * canvas.height];
}, robot);
await page.goto(given[0]);
await page.waitForFunction((robot) => femsense.shown.robots.get(robot)?.shown, robot, { timeout: 60000 });
await page.keyboard.press(' ');                                // the run no longer plays here
await page.click('#drag');
await page.waitForTimeout(500);
const [x, y] = await ball();
"""
DRAG = (
    BEGIN
    + """
await page.click('#arm');
await page.mouse.move(x, y);
await page.mouse.down();
await page.mouse.move(x - 3, y - 12, { steps: 4 });
say({ armed: await on('#arm') });
await told();
await page.waitForFunction(() => document.querySelector('#reach').textContent.includes('measured'), null, { timeout: 20000 });
say({ reach: await page.textContent('#reach'), armed: await on('#arm') });
await page.waitForFunction(() => document.querySelector('#arm').getAttribute('aria-pressed') === 'false', null, { timeout: 60000 });
say({ armed: await on('#arm') });                              // the connection was cut while the button was down
await told();
await page.mouse.move(x - 6, y - 20, { steps: 4 });
await page.waitForTimeout(1000);
say({ armed: await on('#arm') });
await opened.close();
"""
)
STOP = (
    BEGIN
    + """
const other = await opened.newPage({ viewport: { width: 390, height: 844 } });      // neither drags nor is armed
await other.goto(given[0]);
await other.waitForSelector('#stop', { state: 'visible' });
await other.evaluate(() => femsense.shown.stage.renderer.setAnimationLoop(null));      // the machine draws for one page only
const stops = [() => other.click('#stop'), () => other.keyboard.press('Escape'), () => page.keyboard.press('Escape')];
for (const stop of stops) {
  await page.click('#arm');
  await page.mouse.move(x, y);
  await page.mouse.down();
  await page.mouse.move(x - 3, y - 12, { steps: 4 });
  say({ armed: await on('#arm') });
  await told();
  await stop();
  await page.waitForFunction(() => document.querySelector('#arm').getAttribute('aria-pressed') === 'false', null, { timeout: 20000 });
  await page.mouse.move(x - 6, y - 20, { steps: 4 });        // the button is still down
  say({ armed: await on('#arm') });
  await told();
  say({ reach: await page.textContent('#reach') });
  await page.mouse.up();
}
await opened.close();
"""
)


def moving_run(folder: Path) -> Path:
    """A run of a block whose two cables are pulled."""
    robot = load_robot(write_block_robot(folder / "robot"))
    made, names = make_run(robot), robot.body.cable_names
    nodes = [
        fs.solve_equilibrium(robot.body, tension=dict(zip(names, pull))).positions for pull in ((0, 0), (1.0, 0.25), (2.0, 0.5))
    ]
    recording = load_recording(write_small_recording(folder / "recording"))
    run = write_run(
        replace(made, states=replace(made.states, nodes_m=np.array(nodes, dtype=np.float32)), contacts=()),
        folder / "run",
        inputs=run_inputs(robot, recording, None),
    )
    export_run(run, run / "robot.glb", bones=6)
    return run


def commanded(hub: Hub) -> list[list[float]]:
    """A list that fills with the inputs that are commanded."""
    found: list[list[float]] = []

    class Sink:
        def send(self, messages: tuple[Message, ...]) -> None:
            told = [json.loads(message.payload) for message in messages if message.topic.endswith("/command")]
            found.extend([row["value"] for row in one["inputs"]] for one in told if one["armed"])

        def close(self) -> None:
            pass

    hub.attach(Sink())
    return found


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_the_robot_follows_a_pointer_never_jumps_and_stays_when_the_connection_is_cut(
    request: pytest.FixtureRequest, built_page: Path, tmp_path: Path
) -> None:
    run = moving_run(tmp_path)
    other = load_robot(write_block_robot(tmp_path / "other", block=to_quadratic(block_mesh((6, 2, 2)))))
    options = DragOptions(gate=GateOptions(allowed=True))
    with stream_runs([run], StreamOptions(port=0, page=built_page, commands=True)) as live:
        server = let_drag(live, run, options)
        here, targets = Hub(), []
        bridge = Bridge(here, live.url)
        real = ObedientRobot(here, other, server.name, drive_inputs(server.robot))
        commands = commanded(live.hub)
        live.hub.listen(
            lambda message, _: targets.append(json.loads(message.payload)) if message.topic.endswith("/drag") else None
        )
        start = real.place(0)
        assert within(10.0, lambda: not bridge.trouble)
        browser = start_browser(request.config, DRAG, live.url, server.name)
        try:
            assert said(browser) == {"armed": "true"}
            end, wanted = time.monotonic() + 30.0, start
            while time.monotonic() < end and (len(real.heard) < 20 or np.linalg.norm(real.place(0) - wanted) > 1e-3):
                time.sleep(0.05)
                real.report(("tip",))
                wanted = np.array([targets[-1]["target_m"][axis] for axis in "xyz"]) if "target_m" in targets[-1] else wanted
            missed, went = np.linalg.norm(real.place(0) - wanted), np.linalg.norm(real.place(0) - start)
            go_on(browser)
            stop = Event()
            reporting = Thread(target=lambda: [real.report(("tip",)) for _ in iter(lambda: stop.wait(0.1), True)], daemon=True)
            reporting.start()
            seen = said(browser)
            stop.set()
            reporting.join()
            live.server.close()
            assert said(browser) == {"armed": "false"}
            assert within(5.0, lambda: not server.gate.moving)
            count = len(targets)
            again = WebSocketServer(live.hub, live_page_files(built_page), options=ServerOptions(port=live.server.port))
            assert within(20.0, lambda: again.viewers == 2)
            go_on(browser)
            assert said(browser) == {"armed": "false"}
            assert not [told for told in targets[count:] if told["held"]]
            again.close()
        finally:
            browser.kill()
            bridge.close()
    assert missed < 2e-3 and went > 3e-3 and "measured" in seen["reach"]
    most = options.gate.range_per_s * np.array([one.high - one.low for one in server.gate.inputs]) / options.gate.command_hz
    assert len(commands) > 20 and (np.abs(np.diff(commands, axis=0)) <= most + 1e-9).all()


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_a_bystander_s_button_and_anybody_s_escape_key_stop_the_robot(
    request: pytest.FixtureRequest, built_page: Path, tmp_path: Path
) -> None:
    run = moving_run(tmp_path)
    with stream_runs([run], StreamOptions(port=0, page=built_page, commands=True)) as live:
        server = let_drag(live, run, DragOptions(gate=GateOptions(allowed=True)))
        commands = commanded(live.hub)
        browser = start_browser(request.config, STOP, live.url, server.name)
        try:
            for _ in range(3):
                count = len(commands)
                assert said(browser) == {"armed": "true"}
                assert within(20.0, lambda count=count: len(commands) > count)
                go_on(browser)
                assert said(browser) == {"armed": "false"}
                assert within(5.0, lambda: not server.gate.moving)
                count = len(commands)
                time.sleep(0.5)
                assert len(commands) == count  # the held button moves nothing any more
                server.answer("tip", (0.1, 0.0, 0.0))  # one that was under way
                time.sleep(0.3)
                go_on(browser)
                assert said(browser)["reach"].startswith("Stopped")
        finally:
            browser.kill()
