"""The page in a headless browser: how late a pose is seen, and how long a picture of many vertices takes.

    python benchmarks/xr_browser.py [--seconds S] [--vertices N …] [--sizes WxH … headset] [--gpu[="FLAG …"]]

Pictures are drawn by software (SwiftShader), or with --gpu by the machine's graphics card; then the table says its name, and has
three numbers of vertices at four sizes. FLAGs reach Chromium instead of those that are known to find a card without a screen.
CHROMIUM names another browser than the first that is found.

A pose has 12 bones at 60 Hz and carries the moment of sending. One contact with its arrow is on the robot.
In the page it is taken when its message arrives while nothing is drawn ("transport"), and when the first picture with it has been
drawn ("drawn": WebGL finished; the screen comes after that). The clocks of browser and sender are compared by 200 messages to and
fro, of which the fastest counts. Chromium and Node must be there; playwright-core comes by npm into a temporary folder, or is
found in --modules.

A picture takes from the beginning of the page's own step to where WebGL has finished it. "JavaScript" is that until the last call
of WebGL was made, "GPU" what the card's own clock says of those calls. Shadows are drawn anew in each picture. "a second" are
pictures without a screen's pace, each waited for. "headset" is VR in an emulated Quest 3 (iwer): two eyes of 2064 × 2208, the robot
half a metre away; what the emulator does of its own counts in "a second" alone.

    python benchmarks/xr_browser.py --picture FILE --url URL [--press ID …] [--sizes WxH]

takes a picture of a page that runs, after some of its buttons were pressed: those of docs/pictures are of
`femsense stream femsense-demo/run --drag --commands` (--press drag arm, 1200x760; docs/pictures/page-armed.png) and of a sensor stream with a
reading outside of what was learnt (390x844; docs/pictures/page-outside.png).
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from threading import Event, Thread
from types import ModuleType
from typing import Any

import numpy as np
from PIL import Image

from femsense.xr.gltf import glb_bytes
from femsense.xr.skinning import fit_skin
from femsense.xr.stream.bridge import Bridge
from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.mqtt import EmbeddedBroker
from femsense.xr.stream.payloads import Contact, Twin, TwinFrame, bone_rows, read_document
from femsense.xr.stream.publisher import Publisher, PublishOptions
from femsense.xr.stream.websocket import WebSocketServer
from femsense.xr.view import PAGE, live_page_files

ROOT = Path(__file__).resolve().parents[1]
BONES, RATE = 12, 60.0
CHROMIUM = os.environ.get("CHROMIUM") or next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
ALWAYS = ("--no-sandbox", "--disable-quic", "--no-first-run")
SOFTWARE = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
GPU = ("--use-gl=angle", "--use-angle=vulkan", "--enable-features=Vulkan", "--disable-vulkan-surface", "--ignore-gpu-blocklist")
UNLIMITED = ("--disable-frame-rate-limit", "--disable-gpu-vsync")
SMALL, HEADSET = "640x360", "headset"
EYES = (4128, 2208)
"""Two eyes of a Quest 3, side by side [px]."""
NEEDED = ("playwright-core@1.65.1", "iwer@2.5.0")
LOOK = """
const { chromium } = require('playwright-core');
const { readFileSync } = require('fs');
const { browser, args, url, seconds, pictures, width, height, headset } = JSON.parse(process.argv[2]);
(async () => {
  const opened = await chromium.launch({ executablePath: browser, args });
  const page = await opened.newPage({ viewport: { width, height } });
  await page.addInitScript(() => {
    const ask = requestAnimationFrame.bind(globalThis);
    globalThis.requestAnimationFrame = (act) => ask((now) => {
      globalThis.begun = performance.now();
      act(now);
    });
    const Real = WebSocket;
    globalThis.came = [];
    globalThis.pongs = [];
    globalThis.WebSocket = class extends Real {
      constructor(...a) {
        super(...a);
        globalThis.link = this;
        this.addEventListener('message', (event) => {
          const now = performance.now(), view = new DataView(event.data);
          for (let at = 0; at + 6 <= view.byteLength; ) {
            const name = view.getUint16(at, true), size = view.getUint32(at + 2, true), body = at + 6 + name;
            const topic = new TextDecoder().decode(new Uint8Array(event.data, at + 6, name));
            if (topic.endsWith('/pose')) came.push([now, view.getFloat64(body + 8, true)]);
            if (topic.endsWith('/pong')) pongs.push([now, JSON.parse(new TextDecoder().decode(new Uint8Array(event.data, body, size)))]);
            at = body + size;
          }
        });
      }
    };
  });
  if (headset) {
    await page.addInitScript(readFileSync(require.resolve('iwer/build/iwer.min.js'), 'utf8') + `
      const device = new IWER.XRDevice(IWER.metaQuest3, { stereoEnabled: true });
      device.installRuntime({ forceInstall: true });
      device.position.set(0, 1.25, -0.1);
      const ask = XRSession.prototype.requestAnimationFrame;
      XRSession.prototype.requestAnimationFrame = function (act) {
        return ask.call(this, (now, frame) => {
          globalThis.begun = performance.now(); // what the emulator does before is no part of a picture
          act(now, frame);
        });
      };`);
  }
  await page.goto(url);
  await page.waitForFunction(() => [...(globalThis.femsense?.shown.robots.values() ?? [])][0]?.shown, null, { timeout: 120000 });
  if (headset) await page.evaluate(() => femsense.stage.headset.toggle('immersive-vr'));
  const found = await page.evaluate(async ([seconds, pictures]) => {
    const { stage, shown } = femsense, robot = [...shown.robots.values()][0];
    const wait = (ms) => new Promise((done) => setTimeout(done, ms));
    const words = new TextEncoder(), topic = words.encode('femsense/' + robot.id + '/drag');
    for (let k = 0; k < 200; k++) {
      const text = words.encode(JSON.stringify({ ping: performance.now() }));
      const frame = new Uint8Array(6 + topic.length + text.length), view = new DataView(frame.buffer);
      view.setUint16(0, topic.length, true);
      view.setUint32(2, text.length, true);
      frame.set(topic, 6);
      frame.set(text, 6 + topic.length);
      while (link.readyState !== 1) await wait(10); // a page that was held up connects again
      link.send(frame);
      await wait(10);
    }
    const trips = pongs.map(([back, { ping, at }]) => [back - ping, 1000 * at - (ping + back) / 2]).sort((a, b) => a[0] - b[0]);
    const [fastest, offset] = trips[0]; // offset: sender's clock minus ours [ms]
    const from = came.length, still = stage.renderer.render; // messages alone first: what is drawn by software holds up all else
    stage.renderer.render = () => undefined;
    await wait(1000 * seconds);
    const transport = came.slice(from).map(([now, sent]) => now + offset - 1000 * sent);
    stage.renderer.render = still;
    const { renderer } = stage, draw = renderer.render.bind(renderer), gl = renderer.getContext(), pixel = new Uint8Array(4);
    const clock = gl.getExtension('EXT_disjoint_timer_query_webgl2'), queries = [];
    const drawn = [], script = [], took = [];
    let last = null;
    renderer.render = (...a) => {
      const query = clock && gl.createQuery();
      if (clock) gl.beginQuery(clock.TIME_ELAPSED_EXT, query);
      draw(...a);
      if (clock) gl.endQuery(clock.TIME_ELAPSED_EXT);
      script.push(performance.now() - begun);
      renderer.state.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel); // waits until the picture is there
      const now = performance.now();
      took.push(now - begun);
      queries.push(query);
      if (robot.shown !== last) drawn.push(now + offset - 1000 * robot.shown.time_s);
      last = robot.shown;
      if (pictures) stage.touch(); // the next one too, with its shadow
    };
    const start = performance.now(), end = start + 1000 * seconds;
    while (performance.now() < end || took.length < pictures) await wait(50);
    const rate = (1000 * took.length) / (performance.now() - start);
    renderer.render = draw;
    await wait(500); // until the card's clock can be read
    const told = clock ? queries.filter((q) => gl.getQueryParameter(q, gl.QUERY_RESULT_AVAILABLE)) : [];
    const card = told.map((q) => gl.getQueryParameter(q, gl.QUERY_RESULT) / 1e6);
    const named = gl.getExtension('WEBGL_debug_renderer_info'), drawer = gl.getParameter(named ? named.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
    const size = [gl.drawingBufferWidth, gl.drawingBufferHeight], eyes = renderer.xr.isPresenting ? renderer.xr.getCamera().cameras.length : 0;
    return { fastest, transport, drawn, script, took, card, rate, size, eyes, drawer, error: gl.getError() };
  }, [seconds, pictures]);
  console.log(JSON.stringify(found));
  await opened.close();
})().catch((e) => { console.error(e); process.exit(1); });
"""


PICTURE = """
const { chromium } = require('playwright-core');
const { browser, args, url, file, width, height, press } = JSON.parse(process.argv[2]);
(async () => {
  const opened = await chromium.launch({ executablePath: browser, args });
  const page = await opened.newPage({ viewport: { width, height } });
  await page.goto(url);
  await page.waitForTimeout(8000);
  for (const id of press) {
    await page.click(`#${id}`);
    await page.waitForTimeout(1000);
  }
  await page.screenshot({ path: file, timeout: 90000 });
  await opened.close();
})().catch((e) => { console.error(e); process.exit(1); });
"""


def hook() -> ModuleType:
    """The module that finds Node and npm for the wheel."""
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["hatch_build"] = module
    spec.loader.exec_module(module)
    return module


@cache
def tube(vertices: int) -> Twin:
    """A tube of so many vertices with 12 bones."""
    around = 100
    rings = max(2, vertices // around)
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, around, endpoint=False), np.linspace(0.0, 0.2, rings))
    points = np.stack([0.02 * np.cos(angle), 0.02 * np.sin(angle), height], axis=2).reshape(-1, 3)
    i, r = np.meshgrid(np.arange(around), np.arange(rings - 1))
    a, b = (r * around + i).ravel(), (r * around + (i + 1) % around).ravel()
    triangles = np.vstack([np.stack([a, b, a + around], 1), np.stack([b, b + around, a + around], 1)])
    skin = fit_skin(points, points[None], bones=BONES)
    T = skin.skeleton.T_robot_bone
    glb = glb_bytes(points, triangles, skin, T[None], [0.0])
    return Twin("arm", glb, skin.skeleton.names, T)


def send(publisher: Publisher, twin: Twin, stop: Event) -> None:
    """Publish poses that sway and whose time is the moment of sending."""
    rest, begun, k = bone_rows(twin.T_robot_bone), time.monotonic(), 0
    touched = (Contact(0, np.array([0.02, 0.0, 0.15]), np.array([-0.8, 0.0, 0.0]), std_n=0.1),)
    while not stop.wait(max(0.0, begun + k / RATE - time.monotonic())):
        bones = rest.copy()
        bones[:, 0] += 0.1 * rest[:, 2] * np.sin(k / 10)
        publisher.publish(TwinFrame(time.time(), bones, touched))
        k += 1


@dataclass(frozen=True)
class Browser:
    """What opens the page: modules of Node, and what Chromium is told."""

    modules: Path
    flags: tuple[str, ...]

    def look(self, url: str, **given: object) -> dict[str, Any]:
        """Return what the script found in the page."""
        found: dict[str, Any] = json.loads(self._run(LOOK, url, **given).splitlines()[-1])
        if found["error"] or found["size"] != [given["width"], given["height"]] or found["eyes"] != 2 * bool(given["headset"]):
            raise SystemExit(f"WebGL error {found['error']}, {found['size']} pixels, {found['eyes']} eyes")
        return found

    def take(self, url: str, file: Path, size: str, press: list[str]) -> None:
        """Write a picture of a page as PNG with 256 colours."""
        width, height = map(int, size.split("x"))
        self._run(PICTURE, url, file=str(file), width=width, height=height, press=press)
        Image.open(file).convert("RGB").quantize(256).save(file, optimize=True)
        print(f"{file}: {file.stat().st_size // 1000} kB")

    def _run(self, text: str, url: str, **given: object) -> str:
        """Return what a script prints."""
        script = self.modules / "look.cjs"
        script.write_text(text, encoding="utf-8")
        told = json.dumps({"browser": CHROMIUM, "args": [*ALWAYS, *self.flags], "url": url, **given})
        done = subprocess.run(
            [*hook().node_command(), str(script), told], capture_output=True, text=True, timeout=400, check=False
        )
        if done.returncode:
            raise SystemExit(done.stderr)
        return done.stdout


def measure(
    browser: Browser, vertices: int, *, seconds: float = 0.0, broker: bool = False, pictures: int = 0, size: str = SMALL
) -> dict[str, Any]:
    """Stream a tube into the page, by WebSocket or through the embedded broker and a page of its own."""
    headset = size == HEADSET
    width, height = EYES if headset else map(int, size.split("x"))
    twin, stop = tube(vertices), Event()
    hub = Hub()
    publisher = Publisher(hub, twin, PublishOptions(rate_hz=RATE))

    def answer(message: Message, _who: str) -> None:
        told = read_document(message.payload) or {}
        pong = json.dumps({"ping": told.get("ping"), "at": time.time()}).encode()
        hub.publish([Message("femsense/arm/pong", pong)])

    hub.listen(answer)
    with ExitStack() as end:
        end.callback(hub.close)
        page = hub
        if broker:
            page = Hub()
            port = EmbeddedBroker(hub, port=0).port
            end.callback(page.close)
            end.callback(Bridge(page, f"mqtt://127.0.0.1:{port}").close)
        server = WebSocketServer(page, live_page_files(PAGE))
        sender = Thread(target=send, args=(publisher, twin, stop), daemon=True)
        sender.start()
        end.callback(sender.join, 2.0)
        end.callback(stop.set)
        return browser.look(server.url, seconds=seconds, pictures=pictures, width=width, height=height, headset=headset)


def row(name: str, ages: object) -> str:
    p50, p95, p99 = np.percentile(np.asarray(ages, dtype=float), [50, 95, 99])
    return f"| {name} | {p50:.2f} | {p95:.2f} | {p99:.2f} | {len(np.atleast_1d(np.asarray(ages)))} |"


def how_late(browser: Browser, seconds: float) -> None:
    """Print how late messages and poses are."""
    print("| into headless Chromium | p50 [ms] | p95 | p99 | poses |\n|---|---|---|---|---|")
    for name, broker in (("WebSocket", False), ("embedded broker, then WebSocket", True)):
        found = measure(browser, 2000, seconds=seconds, broker=broker)
        print(row(f"{name}: transport", found["transport"]))
        print(row(f"{name}: drawn", found["drawn"]), flush=True)
    print(f"fastest message to and fro {found['fastest']:.2f} ms\n")


def how_long(browser: Browser, vertices: list[int], sizes: list[str], pictures: int) -> None:
    """Print how long pictures take."""
    print("| vertices, picture | JavaScript p50 [ms] | p99 | GPU p50 | p99 | picture p50 | p95 | p99 | a second |")
    print("|---" * 9 + "|")
    for size in sizes:
        for count in vertices:
            found = measure(browser, count, pictures=pictures, size=size)
            script, card = (np.percentile(found[name] or [np.nan], [50, 99]) for name in ("script", "card"))
            took = np.percentile(found["took"], [50, 95, 99])
            figures = " | ".join(f"{figure:.2f}" for figure in (*script, *card, *took))
            print(f"| {count}, {size} | {figures} | {found['rate']:.0f} |", flush=True)


def npm_modules(folder: Path) -> Path:
    """Install what the script needs."""
    install = hook().npm_command(("install", "--ignore-scripts", "--no-audit", "--no-fund", *NEEDED))
    subprocess.run(install, cwd=folder, check=True, capture_output=True)
    return folder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--vertices", type=int, nargs="+")
    parser.add_argument("--sizes", nargs="+")
    parser.add_argument("--gpu", nargs="?", const=" ".join(GPU), metavar="FLAG …")
    parser.add_argument("--modules", type=Path)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--url")
    parser.add_argument("--press", nargs="*", default=[])
    asked = parser.parse_args()
    if CHROMIUM is None:
        raise SystemExit("no Chromium on this machine")
    gpu = asked.gpu is not None
    flags = tuple(asked.gpu.split()) if gpu else SOFTWARE
    print(json.dumps({"cores": os.cpu_count(), "load": round(os.getloadavg()[0], 1)}))
    with tempfile.TemporaryDirectory() as scratch:
        browser = Browser(asked.modules or npm_modules(Path(scratch)), flags)
        if asked.picture:
            browser.take(asked.url, asked.picture, (asked.sizes or [SMALL])[0], asked.press)
            return
        drawer = measure(browser, 1000, pictures=1)["drawer"]
        print(f"drawn by {drawer}\n", flush=True)
        if gpu and any(name in drawer for name in ("SwiftShader", "llvmpipe", "softpipe")):
            raise SystemExit("no graphics card was found; other FLAGs of --gpu may find it")
        how_late(browser, asked.seconds)
        vertices = asked.vertices or ([1000, 10_000, 100_000] if gpu else [100_000])
        sizes = asked.sizes or ([SMALL, "1920x1080", "4128x2208", HEADSET] if gpu else [SMALL])
        how_long(replace(browser, flags=(*flags, *UNLIMITED)) if gpu else browser, vertices, sizes, 300 if gpu else 30)


if __name__ == "__main__":
    main()
