// Streamed robots: the newest data of each, their age, and the last minute.

import { Box3 } from "three";
import { Body, loadMesh } from "./body";
import { Connection, NO_CONNECTION, streamUrl } from "./connection";
import { alignWith, connectTools, notice, paintChoice, paintLegend, toggle } from "./controls";
import { amount, clockText, frameAt, isDoubtful, type Frame } from "./data";
import { Dragging } from "./dragging";
import { pack, readCloud, readField, readForces, readInputs, readLease, readModel, readPose, readReach, readStatus, type Lease, type Message, type Model, type Status } from "./messages";
import type { Field, Paint } from "./paint";
import { COUNT_MS, Pace } from "./pace";
import { Plot } from "./plot";
import { drawCurve, element, showFrame } from "./readout";
import { showPlaying } from "./recorded";
import type { Stage } from "./stage";
import { landmarksOf } from "./ties";

const STALE_S = 0.4; // age above which a robot is shown in grey: within half a second in total
const KEPT_S = 60;
const PLOTTED_S = 30;
const ASKED_MS = 2000; // interval of requests for the reason of a missing robot
const FRAMED_MS = 300; // interval of checks of the view

interface Moment extends Frame {
  bones: Float32Array;
  field: Field | null;
  cloud: Float32Array | null; // x y z residual of each measured point
}

/** Shows all robots of the stream on the server of this page; returns the objects that programs may inspect. */
export function showStreams(stage: Stage): Streams {
  return new Streams(stage);
}

class Streams {
  readonly robots = new Map<string, Robot>();
  private readonly connection: Connection;
  private readonly plot = new Plot(element<HTMLCanvasElement>("plot"));
  private readonly dragging: Dragging;
  private chosen: Robot | null = null;
  private away = NO_CONNECTION; // reason of a missing connection; empty while connected
  private paused = false;
  private at = 0; // displayed time while paused [s]
  private drawn = 0;
  private framed = 0;

  constructor(private readonly stage: Stage) {
    this.connection = new Connection(streamUrl(), (messages) => this.take(messages), (away) => this.connected(away));
    this.dragging = new Dragging(stage, (robot, wish) => this.connection.send(pack(robot, "drag", wish)));
    element("stop").addEventListener("click", () => this.stopAll());
    element("dock").hidden = false;
    element("about").textContent = "waiting for a robot …";
    element("cloud").hidden = element("drag").hidden = true;
    stage.headset.grab = (hand) => this.dragging.take(hand);
    stage.headset.changed = (on) => this.presenting(on);
    this.connect();
    showPlaying(true);
    window.setInterval(() => this.robots.forEach((robot) => robot.pace.count(performance.now())), COUNT_MS);
    window.setInterval(() => void this.ask(), ASKED_MS);
    stage.run(() => this.step());
  }

  private take(messages: Message[]): void {
    for (const { robot, kind, payload } of messages) {
      if (kind === "model") this.announce(robot, readModel(payload));
      else this.robots.get(robot)?.take(kind, payload);
    }
  }

  /** Shows the reason of a missing robot, which `view --stream` provides. */
  private async ask(): Promise<void> {
    if (this.robots.size || this.away) return;
    const told: unknown = await fetch("stream.json").then((answer) => answer.json(), () => null);
    const trouble = (told as { trouble?: unknown } | null)?.trouble;
    if (!this.robots.size) element("about").textContent = typeof trouble === "string" && trouble ? trouble : "waiting for a robot …";
  }

  /** Ends all motion, independent of the holder of the lease. */
  private stopAll(): void {
    for (const robot of this.robots.values()) {
      if (robot.model.commands) this.connection.send(pack(robot.id, "stop", { client: this.dragging.client }));
    }
    this.dragging.stopped();
  }

  private announce(id: string, model: Model | null): void {
    if (!model) return;
    const known = this.robots.get(id);
    if (known?.model.digest === model.digest && known.model.commands === model.commands) return;
    known?.remove();
    const robot = new Robot(id, model, this.stage);
    this.robots.set(id, robot);
    if (!this.chosen || this.chosen === known) this.choose(robot);
    robot.load().then(() => this.arrange(), (reason: Error) => notice(reason.message));
    this.tabs();
  }

  /** In a headset points can be dragged without the button, and the twin can be aligned with the real robot. */
  private presenting(on: boolean): void {
    const robot = this.chosen;
    if (robot?.model.handles.length && on !== this.dragging.on) element("drag").click();
    if (!on || !robot?.body) return;
    const { markers, handles, cameras } = robot.model;
    this.stage.headset.alignment = alignWith(this.stage, robot.body, landmarksOf(robot.body, markers.length ? markers : handles, cameras));
  }

  /** Arranges robots side by side, in the order of their names. */
  private arrange(): void {
    const bodies = [...this.robots.entries()].sort(([a], [b]) => a.localeCompare(b)).flatMap(([, r]) => (r.body ? [r.body] : []));
    const width = 0.8 * Math.max(...bodies.map((b) => b.size));
    const all = new Box3();
    bodies.forEach((body, i) => {
      body.group.position.x = (i - (bodies.length - 1) / 2) * width;
      all.union(body.space().expandByScalar(0.1 * body.size).translate(body.group.position));
    });
    this.stage.fit(all, Math.min(...bodies.map((body) => body.space().min.y)));
    this.choose(this.chosen);
  }

  private choose(robot: Robot | null): void {
    this.chosen = robot;
    if (!robot) return;
    document.title = `${robot.model.name} – femsense live`;
    element("name").textContent = robot.model.name;
    if (robot.model.handles.length) element("drag").hidden = false;
    this.dragging.attend(robot.body ? { id: robot.id, body: robot.body, ...robot.model } : null);
    this.tabs();
  }

  private tabs(): void {
    const list = element("robots");
    list.hidden = this.robots.size < 2;
    list.replaceChildren(
      ...[...this.robots.values()].map((robot) => {
        const tab = document.createElement("button");
        tab.className = "chip";
        tab.textContent = robot.model.name;
        tab.setAttribute("aria-pressed", String(robot === this.chosen));
        tab.addEventListener("click", () => this.choose(robot));
        return tab;
      }),
    );
  }

  private connected(away: string): void {
    this.away = away;
    if (away) this.dragging.letGo();
    this.stage.touch();
  }

  private step(): void {
    const now = performance.now();
    for (const robot of this.robots.values()) robot.step(now, this.paused ? this.at : null, this.away, this.stage);
    this.dragging.step();
    if (now - this.drawn < 100) return;
    this.drawn = now;
    this.read(now);
    if (now - this.framed > FRAMED_MS) this.frame(now);
  }

  /** Keeps all robots and their arrows in view. */
  private frame(now: number): void {
    this.framed = now;
    for (const { body, shown } of this.robots.values()) {
      if (body) this.stage.include(body.extent(shown?.contacts ?? []).translate(body.group.position));
    }
  }

  /** Updates badge, buttons and answers, and the rest of the page while it is visible. */
  private read(now: number): void {
    const robot = this.chosen;
    const badge = element("badge");
    const [state, words] = robot ? robot.state(now, this.away) : [this.away ? "lost" : "waiting", this.away || "no robot yet"];
    document.documentElement.dataset.stream = state;
    const answers = state !== "ended" && !!robot?.model.handles.length;
    if (!answers && this.dragging.on) element("drag").click();
    element("drag").hidden = !answers;
    const doubt = state === "live" && robot?.shown && isDoubtful(robot.shown) ? (robot.shown.forceless ? "outside of what was learnt" : "doubtful") : "";
    const said = [this.paused ? "paused" : "", words, doubt].filter(Boolean).join(" · ");
    badge.dataset.state = doubt ? "doubtful" : this.paused && state === "live" ? "paused" : state;
    if (badge.textContent !== said) badge.textContent = said;
    element("live").setAttribute("aria-pressed", String(!this.paused && state === "live"));
    element("panel").hidden = !robot?.shown;
    if (robot?.shown && robot.reach) this.dragging.answered(robot.reach, robot.ghost);
    if (robot?.lease) this.dragging.leased(robot.lease);
    this.alarm();
    if (robot && !this.stage.headset.alone) this.describe(robot, state);
  }

  /** Shows prominently that the robot moves, or will move when a point is held. */
  private alarm(): void {
    const driven = [...this.robots.values()].filter((robot) => robot.model.commands && !this.away);
    const moving = driven.some((robot) => robot.reach?.armed);
    const words = this.dragging.isArmed
      ? moving ? "The robot is moving: let go and it stops" : "Armed: the robot moves while you hold a point"
      : moving ? "Somebody else is moving the robot" : "";
    element("stop").hidden = driven.length === 0;
    document.documentElement.dataset.alarm = this.dragging.isArmed ? "armed" : moving ? "moving" : "";
    const said = element("alarm");
    said.hidden = !words;
    if (said.textContent !== words) said.textContent = words;
  }

  /** Updates the panel and the time line. */
  private describe(robot: Robot, state: string): void {
    element("about").textContent = robot.reason(state) || robot.about();
    element<HTMLOptionElement>("paint-stress").hidden = !robot.model.field;
    this.legend(element<HTMLSelectElement>("paint").value as Paint);
    element("cloud").hidden = !robot.body?.hasCloud;
    element("legend").hidden = !robot.body?.hasCloud || element("cloud").getAttribute("aria-pressed") !== "true";
    if (robot.body) element("legend-scale").textContent = `${(1000 * robot.body.residualScale).toPrecision(1)} mm`;
    const shown = robot.shown;
    if (!shown) return;
    showFrame(shown, robot.model.inputs, Math.max(robot.body?.arrows.full ?? 0, 1e-9));
    element("panel").dataset.stale = String(state !== "live");
    const newest = robot.newest?.time_s ?? 0;
    const end = this.paused ? Math.max(this.at, newest - KEPT_S + PLOTTED_S) : newest;
    this.plot.draw(robot.history, end - PLOTTED_S, end, shown.time_s);
    this.timeline(robot, newest, shown.time_s);
  }

  private timeline(robot: Robot, newest: number, shown: number): void {
    const scrub = element<HTMLInputElement>("scrub");
    const oldest = robot.history[0]?.time_s ?? newest;
    scrub.min = String(oldest);
    scrub.max = String(Math.max(newest, oldest + 1e-3));
    scrub.value = String(shown);
    scrub.style.setProperty("--done", `${(100 * (shown - oldest)) / Math.max(newest - oldest, 1e-3)}%`);
    scrub.setAttribute("aria-valuetext", this.paused ? `${(newest - shown).toFixed(1)} seconds ago` : "live");
    const every = Math.max(1, Math.floor(robot.history.length / 300));
    drawCurve(robot.history.filter((_, i) => i % every === 0), oldest, newest);
    element("clock").textContent = this.paused ? `${(shown - newest).toFixed(1)} s` : clockText(shown, robot.shown?.run_s ?? null, robot.model.duration);
  }

  private legend(kind: Paint): void {
    const field = this.chosen?.newest?.field;
    paintLegend(kind, this.chosen?.body ?? null, field ? `${amount(field.largest, field.unit)} ${field.name}` : "");
  }

  private pause(on: boolean, at?: number): void {
    this.paused = on;
    this.at = at ?? this.chosen?.newest?.time_s ?? 0;
    showPlaying(!on);
    this.drawn = 0;
    this.stage.touch();
  }

  private jump(moments: number): void {
    const robot = this.chosen;
    if (!robot?.history.length) return;
    const from = frameAt(robot.history, this.paused ? this.at : robot.newest!.time_s);
    this.pause(true, robot.history[Math.max(0, Math.min(robot.history.length - 1, from + moments))]!.time_s);
  }

  private connect(): void {
    const scrub = element<HTMLInputElement>("scrub");
    const bodies = (act: (body: Body) => void): void => {
      for (const robot of this.robots.values()) if (robot.body) act(robot.body);
      this.stage.touch();
    };
    element("speed").hidden = true;
    element("play").addEventListener("click", () => this.pause(!this.paused));
    element("live").addEventListener("click", () => this.pause(false));
    scrub.addEventListener("input", () => this.pause(true, Number(scrub.value)));
    const pressed = (id: string): boolean => element(id).getAttribute("aria-pressed") === "true";
    Robot.dress = (body) => {
      body.showGhost(pressed("ghost"));
      body.showCloud(pressed("cloud"));
      body.showParts(pressed("parts"));
      body.paint(element<HTMLSelectElement>("paint").value as Paint);
      body.arrows.group.visible = pressed("forces");
    };
    const paint = paintChoice((kind) => {
      bodies(Robot.dress);
      this.legend(kind);
    });
    const [ghost, cloud, forces, parts] = ["ghost", "cloud", "forces", "parts"].map((id) => toggle(id, () => bodies(Robot.dress)));
    const drag = toggle("drag", (on) => this.dragging.enable(on));
    const flip = (): void => this.pause(!this.paused);
    connectTools(this.stage, {
      " ": flip,
      k: flip,
      ArrowLeft: () => this.jump(-6),
      ArrowRight: () => this.jump(6),
      End: () => this.pause(false),
      f: forces!,
      b: ghost!,
      c: cloud!,
      o: parts!,
      Escape: () => this.stopAll(),
      m: paint,
      d: drag,
    });
  }
}

/** One robot of the stream. */
class Robot {
  /** Applies the state of the buttons to a body. */
  static dress: (body: Body) => void = () => undefined;

  body: Body | null = null;
  readonly history: Moment[] = [];
  newest: Moment | null = null;
  shown: Moment | null = null;
  reach: ReturnType<typeof readReach> = null;
  lease: Lease | null = null;
  ghost: Float32Array | null = null;
  private forces: ReturnType<typeof readForces> = null;
  private inputs: (number | null)[] | null = null;
  private field: Field | null = null;
  private painted: Field | null = null; // the displayed field
  private cloud: Float32Array | null = null;
  private measured: Float32Array | null = null; // the displayed cloud
  private arrived = -Infinity; // arrival time of the newest pose [ms of the page]
  private told: Status = { state: "", detail: "", since_s: null };
  readonly pace = new Pace();
  private gone = false;

  constructor(
    readonly id: string,
    readonly model: Model,
    private readonly stage: Stage,
  ) {}

  async load(): Promise<void> {
    const body = new Body(await loadMesh(this.model.glb || `robots/${this.id}.glb`));
    if (this.gone) return;
    this.body = body;
    this.stage.robot.add(body.group);
    body.setMarkers(this.model.markers.length ? this.model.markers : this.model.handles);
    Robot.dress(body);
    if (this.newest) this.put(this.newest);
  }

  remove(): void {
    this.gone = true;
    if (this.body) this.stage.robot.remove(this.body.group);
  }

  take(kind: string, payload: Uint8Array): void {
    if (kind === "pose") this.moved(readPose(payload));
    else if (kind === "force") this.forces = readForces(payload);
    else if (kind === "inputs") this.inputs = readInputs(payload);
    else if (kind === "status") this.told = readStatus(payload) ?? this.told;
    else if (kind === "reach") this.reach = readReach(payload);
    else if (kind === "lease") this.lease = readLease(payload);
    else if (kind === "ghost") this.ghost = readPose(payload)?.bones ?? null;
    else if (kind === "cloud") this.cloud = readCloud(payload);
    else if (kind === "field") this.field = this.quantity(readField(payload));
    this.join();
  }

  /** Shows the newest moment, or that at the displayed time while paused; in grey if the stream is not live, paused or not. */
  step(now: number, at: number | null, away: string, stage: Stage): void {
    const body = this.body;
    if (!body) return;
    const wanted = at === null ? this.newest : (this.history[frameAt(this.history, at)] ?? null);
    if (wanted && (wanted !== this.shown || wanted.cloud !== this.measured)) {
      this.put(wanted);
      stage.touch();
    }
    const stale = this.state(now, away)[0] !== "live";
    if (stale !== body.isStale) {
      body.setStale(stale);
      stage.touch();
    }
    body.face(stage.camera, stage.pixelHeight, stage.room);
  }

  /** Returns whether it is live, and its state in words. */
  state(now: number, away: string): [string, string] {
    const { state, detail, since_s } = this.told;
    const silent = state === "stale"; // stated by the sender: a new viewer does not know the age of its first pose
    const told = silent && since_s !== null ? Date.now() / 1000 - since_s : 0;
    const age = Math.max((now - this.arrived) / 1000, told);
    if (state === "ended" && (!away || away === NO_CONNECTION)) return ["ended", "ended"]; // stated before the connection was closed
    if (away) return ["lost", away];
    if (state === "lost") return ["lost", detail ? `no connection to ${detail}` : "source lost"];
    if (state === "waiting" || !Number.isFinite(age)) return ["waiting", `waiting for ${(state === "waiting" && detail) || "the first pose"}`];
    if (silent || age > STALE_S) return ["stale", `stale, ${age < 10 ? age.toFixed(1) : age.toFixed(0)} s old`];
    const hz = this.pace.hz();
    return ["live", hz === null ? "live" : `live, ${Math.round(hz)} Hz`];
  }

  /** Why it is stale, as far as the sender states it. */
  reason(state: string): string {
    return state === "stale" ? this.told.detail : "";
  }

  about(): string {
    const vertices = this.body?.skins.reduce((sum, s) => sum + (s.geometry.getAttribute("position")?.count ?? 0), 0) ?? 0;
    const frame = this.model.inRobotFrame ? "" : " · markers' frame";
    const error = this.model.error === null ? "" : ` · ± ${(1000 * this.model.error).toPrecision(2)} mm where it was tested`;
    return `${this.model.bones.length} bones · ${vertices.toLocaleString("en")} vertices${frame}${error}`;
  }

  private moved(pose: ReturnType<typeof readPose>): void {
    if (!pose) return;
    const now = performance.now();
    this.arrived = now;
    this.pace.take(now, pose.seq);
    if (this.newest && pose.time < this.newest.time_s - 1) this.history.length = 0; // the source restarted
    // without force messages no forces are estimated
    this.newest = {
      time_s: pose.time, bones: pose.bones, frame: null, status: null, rms_after_m: null, inputs: null, contacts: [], forceless: true, field: null, cloud: null,
    };
    this.join();
    this.history.push(this.newest);
    while (this.history.length && this.history[0]!.time_s < pose.time - KEPT_S) this.history.shift();
  }

  private join(): void {
    if (this.newest) Object.assign(this.newest, this.forces ?? {}, { inputs: this.inputs, field: this.field, cloud: this.cloud });
  }

  private put(moment: Moment): void {
    this.shown = moment;
    this.body?.pose(moment.bones);
    this.body?.show(moment.contacts);
    this.body?.setDoubtful(isDoubtful(moment));
    if (!this.body) return;
    if (moment.cloud !== this.measured) {
      this.measured = moment.cloud;
      this.body.setCloud(moment.cloud ?? new Float32Array());
    }
    if (moment.field === this.painted) return;
    this.painted = moment.field;
    this.body.painter.setField(moment.field);
    this.body.painter.frame(0);
  }

  private quantity(read: ReturnType<typeof readField>): Field | null {
    return read && this.model.field ? { ...this.model.field, ...read } : null;
  }
}
