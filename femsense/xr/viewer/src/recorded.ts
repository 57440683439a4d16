// A recorded run: its animation, with the data of each frame.

import { AnimationMixer, type AnimationAction, type Box3 } from "three";
import { Body, loadMesh } from "./body";
import { alignWith, connectTools, notice, paintChoice, paintLegend, toggle } from "./controls";
import { amount, frameAt, isDoubtful, loadRun, type Frame, type Run } from "./data";
import type { Field, Paint } from "./paint";
import { Plot } from "./plot";
import { drawCurve, element, showFrame } from "./readout";
import type { Stage } from "./stage";
import { landmarksOf } from "./ties";

const PLAY = "M8 5v14l11-7z";
const PAUSE = "M7 5h4v14H7zM13 5h4v14h-4z";
const SPEEDS = [1, 0.5, 0.25, 2];

export async function showRun(stage: Stage): Promise<Player> {
  const [gltf, run] = await Promise.all([loadMesh("robot.glb"), loadRun("contacts.json")]);
  const player = new Player(stage, new Body(gltf), run);
  connect(stage, player);
  return player;
}

/** Draws the symbol of the play/pause button. */
export function showPlaying(playing: boolean): void {
  element("play").setAttribute("aria-label", playing ? "Pause" : "Play");
  element("play-icon").setAttribute("d", playing ? PAUSE : PLAY);
}

/** The displayed data, and the displayed time. */
class Player {
  readonly duration: number;
  time = 0;
  playing = false;
  speed = 1;
  private readonly mixer: AnimationMixer;
  private readonly action: AnimationAction | null;
  private readonly times: number[];
  private readonly plot = new Plot(element<HTMLCanvasElement>("plot"));
  private shown = -1;
  private told = -1; // the frame of panel and plot
  private field: Field | null = null;

  constructor(
    private readonly stage: Stage,
    readonly body: Body,
    readonly run: Run | null,
  ) {
    const clip = body.gltf.animations[0];
    this.mixer = new AnimationMixer(body.gltf.scene);
    this.action = clip ? this.mixer.clipAction(clip) : null;
    this.action?.play();
    this.duration = clip?.duration ?? 0;
    this.times = Array.from(clip?.tracks[0]?.times ?? [0]);
    const box = this.space();
    const floor = box.min.y; // of the body; arrows may extend below
    stage.robot.add(body.group);
    body.arrows.largest = body.arrows.full = Math.max(...(run?.frames ?? []).flatMap((f) => f.contacts.map((c) => c.force_n ?? 0)), 1e-9);
    for (const frame of run?.frames ?? []) for (const end of body.arrows.ends(frame.contacts)) box.expandByPoint(end);
    stage.fit(box, floor);
    this.body.setMarkers(run?.markers ?? []);
    const landmarks = landmarksOf(this.body, run?.markers ?? [], run?.cameras ?? []);
    stage.headset.changed = (on) => {
      if (on) stage.headset.alignment = alignWith(stage, this.body, landmarks);
      else this.seek(this.time); // the page was blocked
    };
    new ResizeObserver(() => {
      this.told = -1;
      this.seek(this.time);
    }).observe(element("plot"));
    this.describe();
  }

  step(seconds: number): void {
    if (this.playing && this.duration > 0) this.seek((this.time + this.speed * seconds) % this.duration);
    this.body.face(this.stage.camera, this.stage.pixelHeight, this.stage.room);
  }

  /** Shows a time [s]. */
  seek(time: number): void {
    this.time = Math.min(Math.max(time, 0), this.duration);
    this.pose(this.time);
    const frames = this.run?.frames ?? [];
    const now = frames.length ? frameAt(frames, this.time) : -1;
    if (now !== this.shown && now >= 0) {
      this.body.show(frames[now]!.contacts);
      this.body.painter.frame(now);
      this.body.setDoubtful(isDoubtful(frames[now]!));
    }
    this.shown = now;
    if (!this.stage.headset.alone) this.tell(frames);
    this.stage.touch();
  }

  /** Updates clock, panel and plot. */
  private tell(frames: Frame[]): void {
    this.clock();
    const frame = this.shown === this.told ? undefined : frames[this.shown];
    this.told = this.shown;
    if (!frame) return;
    showFrame(frame, this.run!.inputs, this.body.arrows.full);
    this.plot.draw(frames, 0, this.duration, frame.time_s);
  }

  /** Steps some frames forward or back. */
  jump(frames: number): void {
    this.play(false);
    const nearest = this.times.reduce((best, t, i) => (Math.abs(t - this.time) < Math.abs(this.times[best]! - this.time) ? i : best), 0);
    this.seek(this.times[Math.min(Math.max(nearest + frames, 0), this.times.length - 1)]!);
  }

  play(on: boolean): void {
    this.playing = on && this.duration > 0;
    showPlaying(this.playing);
  }

  /** Colours the body; a field is loaded at its first use. */
  async paint(paint: Paint): Promise<void> {
    const told = this.run?.field;
    if (paint === "stress" && told && !this.field) {
      const answer = await fetch("fields.bin");
      if (!answer.ok) return notice(`fields.bin could not be loaded (${answer.status}).`);
      const bytes = await answer.arrayBuffer();
      this.field = { ...told, largest: new DataView(bytes).getFloat32(0, true), values: new Uint8Array(bytes, 4) };
      this.body.painter.setField(this.field);
      this.body.painter.frame(Math.max(this.shown, 0));
    }
    this.body.paint(paint);
    paintLegend(paint, this.body, this.field ? `${amount(this.field.largest, this.field.unit)} ${this.field.name}` : "");
    this.stage.touch();
  }

  private pose(time: number): void {
    if (!this.action) return;
    this.action.time = time;
    this.mixer.update(0);
  }

  private clock(): void {
    const scrub = element<HTMLInputElement>("scrub");
    scrub.value = String(this.time);
    scrub.style.setProperty("--done", `${this.duration ? (100 * this.time) / this.duration : 0}%`);
    scrub.setAttribute("aria-valuetext", `${this.time.toFixed(2)} seconds`);
    const clock = element("clock");
    clock.innerHTML = "<strong></strong>";
    clock.firstElementChild!.textContent = this.time.toFixed(2);
    clock.append(` / ${this.duration.toFixed(2)} s`);
  }

  /** Returns the bounding box of the body over the run. */
  private space(): Box3 {
    const box = this.body.space();
    const every = Math.max(1, Math.floor(this.times.length / 24));
    for (let i = 0; i < this.times.length; i += every) {
      this.pose(this.times[i]!);
      box.union(this.body.space());
    }
    return box;
  }

  private describe(): void {
    const { skins, bones, gltf } = this.body;
    const name = this.run?.name || gltf.scene.name || "robot";
    document.title = `${name} – femsense`;
    element("name").textContent = name;
    const vertices = skins.reduce((sum, b) => sum + (b.geometry.getAttribute("position")?.count ?? 0), 0);
    element("about").textContent = `${this.times.length} frames · ${bones.length} bones · ${vertices.toLocaleString("en")} vertices`;
    element<HTMLInputElement>("scrub").max = String(this.duration || 1);
    element("dock").hidden = false;
    if (!this.run) {
      element("forces").hidden = true;
      return;
    }
    element("panel").hidden = false;
    element<HTMLOptionElement>("paint-stress").hidden = !this.run.field;
    drawCurve(this.run.frames, 0, this.duration);
  }
}

function connect(stage: Stage, player: Player): void {
  const asked = new URLSearchParams(location.search);
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const scrub = element<HTMLInputElement>("scrub");
  element("play").addEventListener("click", () => player.play(!player.playing));
  scrub.addEventListener("input", () => {
    player.play(false);
    player.seek(Number(scrub.value));
  });
  element("speed").addEventListener("click", () => {
    player.speed = SPEEDS[(SPEEDS.indexOf(player.speed) + 1) % SPEEDS.length]!;
    element("speed").textContent = `${player.speed}×`;
  });
  const ghost = toggle("ghost", (on) => {
    player.body.showGhost(on);
    stage.touch();
  });
  const paint = paintChoice((kind) => void player.paint(kind));
  const forces = toggle("forces", (on) => {
    player.body.arrows.group.visible = on;
    stage.touch();
  });
  const parts = toggle("parts", (on) => {
    player.body.showParts(on);
    stage.touch();
  });
  element("cloud").hidden = element("live").hidden = element("drag").hidden = true;
  connectTools(stage, {
    " ": () => player.play(!player.playing),
    k: () => player.play(!player.playing),
    ArrowLeft: () => player.jump(-1),
    ArrowRight: () => player.jump(1),
    Home: () => player.seek(0),
    End: () => player.seek(player.duration),
    f: forces,
    b: ghost,
    o: parts,
    m: paint,
  });
  player.seek(Number(asked.get("time") ?? 0) || 0);
  player.play(asked.get("play") === "1" || (asked.get("play") !== "0" && !calm));
  stage.run((seconds) => player.step(seconds));
}
