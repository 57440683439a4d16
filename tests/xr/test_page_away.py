"""What the page says, and what it no longer offers, when the stream has ended or comes back with another password."""

from __future__ import annotations

from pathlib import Path

import pytest
from browser import CHROMIUM, go_on, said, start_browser
from live_bars import Source
from streams import within
from xr_bar import write_run_with_mesh

from femsense.xr.stream.access import Access
from femsense.xr.stream.hub import Hub
from femsense.xr.stream.run_source import open_run
from femsense.xr.stream.websocket import ServerOptions, WebSocketServer
from femsense.xr.view import live_page_files

pytest.importorskip("websockets")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")

ENDED = """
const page = await opened.newPage({ viewport: { width: 390, height: 844 } });
const told = () => new Promise((done) => process.stdin.once('data', done));
const look = async () => console.log(JSON.stringify(await page.evaluate(() => ({
  ended: document.documentElement.dataset.stream === 'ended',
  button: document.querySelector('#drag').checkVisibility(), box: document.querySelector('#dragging').checkVisibility() }))));
const stream = (state) => page.waitForFunction((s) => document.documentElement.dataset.stream === s, state, { timeout: 60000 });
await page.goto(given[0]);
await page.waitForFunction(() => femsense.shown.robots.get('bar')?.shown, null, { timeout: 60000 });
await stream('live');
const offered = (on) => page.waitForFunction((on) => document.querySelector('#drag').checkVisibility() === on, on, { timeout: 60000 });
await page.click('#drag');
await look();
await page.click('#robots button:nth-child(2)');   // a robot without points
await offered(false);
await look();
await page.click('#robots button:nth-child(1)');
await offered(true);
await page.click('#drag');
await look();
await told();
await stream('ended');
await offered(false);
await look();
await opened.close();
"""


def test_a_robot_without_points_and_a_stream_that_has_ended_offer_none_to_drag(
    request: pytest.FixtureRequest, built_page: Path, tmp_path: Path
) -> None:
    source = Source(open_run(write_run_with_mesh(tmp_path / "bar")), built_page, still=True, commands=True)
    browser = start_browser(request.config, ENDED, source.server.url)
    try:
        assert said(browser) == {"ended": False, "button": True, "box": True}
        assert said(browser) == {"ended": False, "button": False, "box": False}
        assert said(browser) == {"ended": False, "button": True, "box": True}
        for publisher in source.publishers:
            publisher.end()
        go_on(browser)
        assert said(browser) == {"ended": True, "button": False, "box": False}
    finally:
        source.close()
        browser.kill()


PASSWORD = """
const page = await opened.newPage({ httpCredentials: { username: 'me', password: 'old' }, viewport: { width: 390, height: 844 } });
const said = [];
await page.goto(given[0]);
await page.waitForFunction(() => document.querySelector('#badge').textContent === 'no robot yet', null, { timeout: 60000 });
console.log('{}');
await page.waitForFunction(() => document.querySelector('#badge').textContent.startsWith('password'), null, { timeout: 60000 });
for (let i = 0; i < 40; i++) {
  said.push(await page.textContent('#badge'));
  await page.waitForTimeout(100);
}
console.log(JSON.stringify({ said: [...new Set(said)], aside: await page.evaluate(() => document.documentElement.scrollWidth > innerWidth) }));
await opened.close();
"""


def test_a_server_that_comes_back_with_another_password_is_said_to_refuse_it(
    request: pytest.FixtureRequest, built_page: Path
) -> None:
    hub, files = Hub(), live_page_files(built_page)
    server = WebSocketServer(hub, files, access=Access(password="old"))
    browser = start_browser(request.config, PASSWORD, server.url)
    try:
        assert said(browser) == {} and within(10.0, lambda: server.viewers == 1)
        server.close()
        again = WebSocketServer(hub, files, access=Access(password="new"), options=ServerOptions(port=server.port))
        assert said(browser) == {"said": ["password refused: load the page again"], "aside": False}
        assert again.viewers == 0
    finally:
        hub.close()
        browser.kill()
