"""The page in a headless browser, drawn by software: how late a pose is seen, and how long a picture of many vertices takes.

    python benchmarks/xr_browser.py [--seconds S] [--vertices N]

A pose has 12 bones at 60 Hz and carries the moment of sending.
In the page it is taken when its message arrives while nothing is drawn ("transport"), and when the first picture with it has been
drawn ("drawn": WebGL finished; the screen comes after that). The clocks of browser and sender are compared by 200 messages to and
fro, of which the fastest counts. Chromium and Node must be there; playwright-core comes by npm into a temporary folder.
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
from pathlib import Path
from threading import Event, Thread
from types import ModuleType

import numpy as np

from femsense.xr.gltf import glb_bytes
from femsense.xr.skinning import fit_skin
from femsense.xr.stream.bridge import Bridge
from femsense.xr.stream.hub import Hub, Message
from femsense.xr.stream.mqtt import EmbeddedBroker
from femsense.xr.stream.payloads import Twin, TwinFrame, bone_rows, read_document
from femsense.xr.stream.publisher import Publisher, PublishOptions
from femsense.xr.stream.websocket import WebSocketServer
from femsense.xr.view import PAGE, live_page_files

ROOT = Path(__file__).resolve().parents[1]
BONES, RATE = 12, 60.0
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
LOOK = """
const { chromium } = require('playwright-core');
const [browser, url, seconds, pictures] = process.argv.slice(2);
const args = ['--no-sandbox', '--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--disable-quic', '--no-first-run'];
(async () => {
  const opened = await chromium.launch({ executablePath: browser, args });
  const page = await opened.newPage({ viewport: { width: 640, height: 360 } });
  await page.addInitScript(() => {
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
  await page.goto(url);
  await page.waitForFunction(() => [...(globalThis.femsense?.shown.robots.values() ?? [])][0]?.shown, null, { timeout: 120000 });
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
    const drawn = [], took = [];
    let last = null;
    renderer.render = (...a) => {
      const begun = performance.now();
      draw(...a);
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel); // waits until the picture is there
      const now = performance.now();
      took.push(now - begun);
      if (robot.shown !== last) drawn.push(now + offset - 1000 * robot.shown.time_s);
      last = robot.shown;
    };
    const end = performance.now() + 1000 * seconds;
    while (performance.now() < end || took.length < pictures) await wait(50);
    return { fastest, transport, drawn, took, vertices: robot.about() };
  }, [Number(seconds), Number(pictures)]);
  console.log(JSON.stringify(found));
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
    while not stop.wait(max(0.0, begun + k / RATE - time.monotonic())):
        bones = rest.copy()
        bones[:, 0] += 0.1 * rest[:, 2] * np.sin(k / 10)
        publisher.publish(TwinFrame(time.time(), bones))
        k += 1


def look(url: str, folder: Path, seconds: float, pictures: int) -> dict[str, object]:
    script = folder / "look.cjs"
    script.write_text(LOOK, encoding="utf-8")
    command = [*hook().node_command(), str(script), str(CHROMIUM), url, str(seconds), str(pictures)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=400, check=False)
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def measure(folder: Path, vertices: int, seconds: float, *, broker: bool, pictures: int = 0) -> dict[str, object]:
    """Stream a tube into the page, by WebSocket or through the embedded broker and a page of its own."""
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
        return look(server.url, folder, seconds, pictures)


def row(name: str, ages: object) -> str:
    p50, p95, p99 = np.percentile(np.asarray(ages, dtype=float), [50, 95, 99])
    return f"| {name} | {p50:.2f} | {p95:.2f} | {p99:.2f} | {len(np.atleast_1d(np.asarray(ages)))} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--vertices", type=int, default=100_000)
    asked = parser.parse_args()
    if CHROMIUM is None:
        raise SystemExit("no Chromium on this machine")
    print(json.dumps({"cores": os.cpu_count(), "load": round(os.getloadavg()[0], 1)}))
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        install = hook().npm_command(("install", "--ignore-scripts", "--no-audit", "--no-fund", "playwright-core@1.65.1"))
        subprocess.run(install, cwd=folder, check=True, capture_output=True)
        print("| into headless Chromium | p50 [ms] | p95 | p99 | poses |\n|---|---|---|---|---|")
        for name, broker in (("WebSocket", False), ("embedded broker, then WebSocket", True)):
            found = measure(folder, 2000, asked.seconds, broker=broker)
            print(row(f"{name}: transport", found["transport"]))
            print(row(f"{name}: drawn", found["drawn"]), flush=True)
        print(f"fastest message to and fro {found['fastest']:.2f} ms")
        found = measure(folder, asked.vertices, 0.0, broker=False, pictures=30)
        print(f"\n| {found['vertices']}, 640 × 360, software | p50 [ms] | p95 | p99 | pictures |\n|---|---|---|---|---|")
        print(row("a picture", found["took"]))


if __name__ == "__main__":
    main()
