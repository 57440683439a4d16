// The page: loads robot.glb and contacts.json, plays the run, shows the contact forces.

import "./style.css";
import { AnimationMixer, Box3, Group, Mesh, SkinnedMesh, type AnimationAction, type Object3D } from "three";
import { GLTFLoader, type GLTF } from "three/addons/loaders/GLTFLoader.js";
import { ForceArrows } from "./arrows";
import { frameAt, loadRun, type Run } from "./data";
import { drawCurve, element, showFrame } from "./readout";
import { Stage } from "./stage";

const PLAY = "M8 5v14l11-7z";
const PAUSE = "M7 5h4v14H7zM13 5h4v14h-4z";
const SPEEDS = [1, 0.5, 0.25, 2];

main().catch((reason: unknown) => fail(reason instanceof Error ? reason.message : String(reason)));

async function main(): Promise<void> {
  const stage = openStage();
  const [gltf, run] = await Promise.all([loadRobot("robot.glb"), loadRun("contacts.json")]);
  const player = new Player(stage, gltf, run);
  connect(stage, player);
  offerHeadset(stage);
  document.documentElement.dataset.state = "ready";
}

/** What is shown at a time, and the time that is shown. */
class Player {
  readonly duration: number;
  time = 0;
  playing = false;
  speed = 1;
  private readonly mixer: AnimationMixer;
  private readonly action: AnimationAction | null;
  private readonly arrows: ForceArrows;
  private readonly largest: number;
  private readonly times: number[];
  private shown = -1;

  constructor(
    private readonly stage: Stage,
    gltf: GLTF,
    private readonly run: Run | null,
  ) {
    const clip = gltf.animations[0];
    this.mixer = new AnimationMixer(gltf.scene);
    this.action = clip ? this.mixer.clipAction(clip) : null;
    this.action?.play();
    this.duration = clip?.duration ?? 0;
    this.times = Array.from(clip?.tracks[0]?.times ?? [0]);
    const bodies = skinned(gltf.scene);
    const box = this.space(bodies);
    stage.robot.add(gltf.scene);
    this.largest = Math.max(...(run?.frames ?? []).flatMap((f) => f.contacts.map((c) => c.force_n ?? 0)), 1e-9);
    this.arrows = new ForceArrows(box.getSize(box.max.clone()).length(), this.largest);
    const robotFrame = new Group(); // Z up; the page is Y up
    robotFrame.rotation.x = -Math.PI / 2;
    robotFrame.add(this.arrows.group);
    stage.robot.add(robotFrame);
    stage.fit(box);
    this.describe(gltf, bodies);
  }

  step(seconds: number): void {
    if (this.playing && this.duration > 0) this.seek((this.time + this.speed * seconds) % this.duration);
    this.arrows.face(this.stage.camera, this.stage.pixelHeight);
  }

  /** Shows a time [s]. */
  seek(time: number): void {
    this.time = Math.min(Math.max(time, 0), this.duration);
    this.pose(this.time);
    this.clock();
    const frames = this.run?.frames ?? [];
    const now = frames.length ? frameAt(frames, this.time) : -1;
    if (now !== this.shown && now >= 0) {
      this.arrows.show(frames[now]!.contacts);
      showFrame(frames[now]!, this.largest);
    }
    this.shown = now;
    this.stage.touch();
  }

  /** Goes some frames on or back. */
  jump(frames: number): void {
    this.play(false);
    const nearest = this.times.reduce((best, t, i) => (Math.abs(t - this.time) < Math.abs(this.times[best]! - this.time) ? i : best), 0);
    this.seek(this.times[Math.min(Math.max(nearest + frames, 0), this.times.length - 1)]!);
  }

  play(on: boolean): void {
    this.playing = on && this.duration > 0;
    element("play").setAttribute("aria-label", this.playing ? "Pause" : "Play");
    element("play-icon").setAttribute("d", this.playing ? PAUSE : PLAY);
  }

  showForces(visible: boolean): void {
    this.arrows.group.visible = visible;
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
    const spoken = `${this.time.toFixed(2)} of ${this.duration.toFixed(2)} s`;
    scrub.setAttribute("aria-valuetext", spoken);
    element("clock").innerHTML = `<strong>${this.time.toFixed(2)}</strong> / ${this.duration.toFixed(2)} s`;
  }

  /** Returns the box around all that the body does. */
  private space(bodies: SkinnedMesh[]): Box3 {
    const box = new Box3();
    const every = Math.max(1, Math.floor(this.times.length / 24));
    for (let i = 0; i < this.times.length; i += every) {
      this.pose(this.times[i]!);
      for (const body of bodies) {
        body.parent?.parent?.updateMatrixWorld(true);
        body.updateMatrixWorld(true);
        body.skeleton.bones.forEach((bone) => bone.parent?.updateMatrixWorld(true));
        body.computeBoundingBox();
        if (body.boundingBox) box.union(body.boundingBox);
      }
    }
    return box;
  }

  private describe(gltf: GLTF, bodies: SkinnedMesh[]): void {
    const name = this.run?.name || gltf.scene.name || "robot";
    document.title = `${name} – femsense`;
    element("name").textContent = name;
    const bones = bodies.reduce((sum, b) => sum + b.skeleton.bones.length, 0);
    const vertices = bodies.reduce((sum, b) => sum + (b.geometry.getAttribute("position")?.count ?? 0), 0);
    element("about").textContent = `${this.times.length} frames · ${bones} bones · ${vertices.toLocaleString("en")} vertices`;
    element<HTMLInputElement>("scrub").max = String(this.duration || 1);
    element("dock").hidden = false;
    if (!this.run) {
      element("forces").hidden = true;
      return;
    }
    element("panel").hidden = false;
    drawCurve(this.run.frames, this.duration);
  }
}

function openStage(): Stage {
  try {
    return new Stage(element<HTMLCanvasElement>("view"));
  } catch {
    throw new Error("This browser does not give the page WebGL 2.\nSwitch on hardware acceleration, or try another browser.");
  }
}

async function loadRobot(url: string): Promise<GLTF> {
  const answer = await fetch(url);
  if (!answer.ok) throw new Error(`${url} could not be loaded (${answer.status}).\nIs the run complete? femsense export RUN -o robot.glb writes it.`);
  return await new GLTFLoader().parseAsync(await answer.arrayBuffer(), "");
}

function skinned(scene: Object3D): SkinnedMesh[] {
  const found: SkinnedMesh[] = [];
  scene.traverse((node) => {
    if (!(node instanceof Mesh)) return;
    node.castShadow = true;
    node.receiveShadow = true;
    node.frustumCulled = false;
    if (node instanceof SkinnedMesh) found.push(node);
  });
  if (!found.length) throw new Error("robot.glb holds no skinned mesh.");
  return found;
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
  const forces = toggle("forces", (on) => player.showForces(on));
  const grid = toggle("grid", (on) => stage.showGround(on));
  element("reset").addEventListener("click", () => stage.lookFromStart());
  element("speed").addEventListener("click", () => {
    player.speed = SPEEDS[(SPEEDS.indexOf(player.speed) + 1) % SPEEDS.length]!;
    element("speed").textContent = `${player.speed}×`;
  });
  const keys: Record<string, () => void> = {
    " ": () => player.play(!player.playing),
    k: () => player.play(!player.playing),
    ArrowLeft: () => player.jump(-1),
    ArrowRight: () => player.jump(1),
    Home: () => player.seek(0),
    End: () => player.seek(player.duration),
    f: forces,
    g: grid,
    r: () => stage.lookFromStart(),
  };
  window.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const onButton = event.target instanceof HTMLButtonElement && (event.key === " " || event.key === "Enter");
    const act = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!act || onButton) return;
    event.preventDefault();
    act();
  });
  player.seek(Number(asked.get("time") ?? 0) || 0);
  player.play(asked.get("play") === "1" || (asked.get("play") !== "0" && !calm));
  stage.run((seconds) => player.step(seconds));
}

/** Makes a button that is on or off; returns what its key does. */
function toggle(id: string, change: (on: boolean) => void): () => void {
  const button = element<HTMLButtonElement>(id);
  const act = (): void => {
    const on = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", String(on));
    change(on);
  };
  button.addEventListener("click", act);
  return act;
}

function offerHeadset(stage: Stage): void {
  for (const [id, mode] of [
    ["enter-vr", "immersive-vr"],
    ["enter-ar", "immersive-ar"],
  ] as const) {
    const button = element<HTMLButtonElement>(id);
    navigator.xr?.isSessionSupported(mode).then(
      (yes) => (button.hidden = !yes),
      () => (button.hidden = true),
    );
    button.addEventListener("click", () => stage.enter(mode).catch((e: Error) => notice(`The headset did not open: ${e.message}`)));
  }
}

function fail(message: string): void {
  document.documentElement.dataset.state = "error";
  element("about").textContent = "";
  notice(message);
}

function notice(message: string): void {
  const box = element("message");
  box.textContent = message;
  box.hidden = false;
}
