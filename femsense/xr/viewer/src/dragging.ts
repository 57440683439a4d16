// Control of the robot: a point of the twin is dragged, the server answers with the reachable state, and commands are sent while armed and held.

import {
  BufferGeometry,
  Color,
  Line,
  LineBasicMaterial,
  Matrix4,
  Mesh,
  MeshBasicMaterial,
  MeshStandardMaterial,
  Plane,
  Raycaster,
  SkinnedMesh,
  SphereGeometry,
  Vector2,
  Vector3,
  type Bone,
} from "three";
import { clone } from "three/addons/utils/SkeletonUtils.js";
import { poseBones, type Body } from "./body";
import { amount, type NamedPoint } from "./data";
import type { Lease, Reach } from "./messages";
import { tied, type Hand, type Hold } from "./headset";
import { element } from "./readout";
import { tie } from "./ties";
import type { Stage } from "./stage";

const EVERY_MS = 33; // interval of the targets while held, independent of the frame rate: the robot stops when they stop
const BLIND_MS = 1000; // without a new image for this long no target is sent
const BY_FINGER = matchMedia("(pointer: coarse)").matches;
const HINT = BY_FINGER ? "Drag a green point with a finger." : "Drag a green point, or hold Shift and use the arrow keys.";
const FINGER = 28; // distance within which a finger grabs a handle [px]
const STEP = 0.01; // step of a key, relative to the body's size
const TOUCH = 0.03; // distance within which a hand grabs a handle [m]
const NEAR = 0.04; // distance from a handle within which a ray points at it, relative to the body's size

interface Subject {
  id: string;
  body: Body;
  handles: NamedPoint[];
  commands: boolean;
}

export class Dragging {
  private subject: Subject | null = null;
  private readonly balls: Mesh[] = [];
  private readonly line = new Line(new BufferGeometry(), new LineBasicMaterial({ color: 0x7df0c0 }));
  private readonly target = new Mesh(new SphereGeometry(1, 20, 14), new MeshBasicMaterial({ color: 0x7df0c0, transparent: true, opacity: 0.85 }));
  private twin: { root: ReturnType<typeof clone>; bones: Bone[] } | null = null;
  private held: number | null = null;
  private chosen = 0;
  private enabled = false;
  private armed = false;
  private sent = 0;
  private seen = 0; // time of the last image
  private heard: Reach | null = null; // the newest answer, and the displayed one
  private shown: Reach | null = null;
  private seq = 0;
  private lease: Lease | null = null;
  private refused = false; // a stop, or another client: answers do not replace the displayed reason
  /** Identifier of this page among the clients. */
  readonly client = Array.from(crypto.getRandomValues(new Uint8Array(12)), (byte) => byte.toString(16).padStart(2, "0")).join("");
  private readonly plane = new Plane();
  private readonly ray = new Raycaster();
  private readonly wish = new Vector3(); // target, in world coordinates
  private places: (() => Vector3)[] = [];

  constructor(
    private readonly stage: Stage,
    private readonly send: (robot: string, wish: object) => void,
  ) {
    stage.scene.add(this.line, this.target);
    this.line.visible = this.target.visible = false;
    this.line.frustumCulled = false;
    const canvas = stage.renderer.domElement;
    canvas.addEventListener("pointerdown", (e) => this.grab(e), { capture: true });
    canvas.addEventListener("pointermove", (e) => this.move(e));
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"] as const) canvas.addEventListener(end, () => this.release());
    window.addEventListener("blur", () => this.release());
    window.addEventListener("keydown", (e) => this.key(e));
    window.addEventListener("keyup", (e) => e.key.startsWith("Arrow") && this.release());
    element("arm").addEventListener("click", () => (this.armed ? this.letGo() : this.arm(true)));
    element<HTMLSelectElement>("handles").addEventListener("change", () => (this.chosen = element<HTMLSelectElement>("handles").selectedIndex));
    window.setInterval(() => this.repeat(), EVERY_MS);
  }

  /** Selects another robot for dragging. */
  attend(subject: Subject | null): void {
    if (subject?.body === this.subject?.body) return;
    this.release();
    for (const ball of this.balls.splice(0)) ball.removeFromParent();
    this.twin?.root.removeFromParent();
    this.twin = null;
    this.subject = subject;
    this.arm(false);
    element("arm").hidden = !subject?.commands;
    if (!subject) return;
    for (const handle of subject.handles) {
      const ball = new Mesh(
        new SphereGeometry(0.022 * subject.body.size, 20, 14),
        new MeshBasicMaterial({ color: 0x7df0c0, transparent: true, opacity: 0.9, depthTest: false }),
      );
      ball.name = handle.name;
      ball.renderOrder = 5;
      ball.visible = this.enabled;
      subject.body.group.add(ball);
      this.balls.push(ball);
    }
    this.places = subject.handles.map((handle) => tie(subject.body, handle.position));
    this.choices();
  }

  get on(): boolean {
    return this.enabled;
  }

  enable(on: boolean): void {
    this.enabled = on;
    this.release();
    if (!on) this.arm(false);
    for (const ball of this.balls) ball.visible = on;
    if (this.twin) this.twin.root.visible = false;
    this.line.visible = this.target.visible = false;
    element("dragging").hidden = !on;
    this.shown = this.heard; // earlier answers belong to another client
    this.refused = false;
    if (on) this.tell(HINT, "", "");
    this.stage.panelsChanged();
  }

  get isArmed(): boolean {
    return this.armed;
  }

  /** Ends a drag and disarms, with a message: after a stop it is required before the robot can move again. */
  letGo(): void {
    this.release();
    this.arm(false);
    this.open();
  }

  /** Records the holder of the lease. */
  leased(lease: Lease): void {
    if (lease === this.lease) return;
    const stoppedNow = lease.stopped && lease.number !== this.lease?.number; // it is repeated until somebody holds a lease again
    this.lease = lease;
    if (stoppedNow && (this.armed || this.held !== null)) {
      this.stopped();
    } else if (this.held !== null && lease.client && lease.client !== this.client) {
      this.refuse("Somebody else is dragging this robot: yours comes after.");
    } else if (lease.client === this.client) {
      this.refused = false;
    }
  }

  /** Lets go after a stop, and states it until the robot is armed or a point is held again. */
  stopped(): void {
    this.letGo();
    if (this.subject?.commands) this.refuse("Stopped. Arm the robot again to go on.");
  }

  private refuse(reason: string): void {
    this.refused = true;
    this.tell(reason, "stopped", "");
  }

  /** The sender's part of each message: its lease, or 0 to request one. */
  private sender(): object {
    return { client: this.client, seq: this.seq++, lease: this.lease?.client === this.client ? this.lease.number : 0 };
  }

  /** Sends that nothing is held. */
  private open(): void {
    if (this.subject) this.send(this.subject.id, { ...this.sender(), handle: "", held: false, armed: false });
  }

  /** Repeats the target while a point is held and the page is drawn. */
  private repeat(): void {
    const now = performance.now();
    if (this.held !== null && now - this.sent >= EVERY_MS - 5 && now - this.seen < BLIND_MS) this.say();
  }

  private tell(text: string, status: string, inputs: string): void {
    const said = element("reach");
    said.textContent = text;
    said.dataset.status = status;
    element("reach-inputs").textContent = inputs;
  }

  /** Places the handles on the body. */
  step(): void {
    this.seen = performance.now();
    if (!this.enabled || !this.subject) return;
    this.balls.forEach((ball, i) => {
      ball.position.copy(this.places[i]!());
      ball.scale.setScalar(i === (this.held ?? this.chosen) ? 1.25 : 1);
    });
  }

  /** Sends the target of the held point. */
  private say(): void {
    if (this.held === null || !this.subject) return;
    this.sent = performance.now();
    const local = this.subject.body.robotFrame.worldToLocal(this.wish.clone());
    const wish = { handle: this.subject.handles[this.held]!.name, target_m: { x: local.x, y: local.y, z: local.z }, held: true, armed: this.armed };
    this.send(this.subject.id, { ...this.sender(), ...wish });
    this.draw();
  }

  /** Grabs a handle that a hand touches or points at; the target then moves with the hand. */
  take(hand: Hand): Hold | null {
    if (!this.enabled || !this.subject || this.held !== null) return null;
    const places = this.balls.map((ball) => ball.getWorldPosition(new Vector3()));
    const size = NEAR * this.subject.body.size;
    const touched = closest(places.map((place) => place.distanceTo(hand.point)), TOUCH);
    const index = touched ?? closest(places.map((place) => hand.ray.distanceToPoint(place)), size);
    if (index === null) return null;
    this.begin(index);
    const place = tied(hand, new Matrix4().setPosition(this.wish));
    const follow = (): void => void this.wish.setFromMatrixPosition(place());
    if (!this.subject.commands || this.armed) return { follow, release: () => this.release() };
    return { follow, ...this.byBothHands() };
  }

  /** The robot follows while the other hand is closed as well. */
  private byBothHands(): Pick<Hold, "release" | "second"> {
    const { headset } = this.stage;
    const second = (closed: boolean): void => {
      if (this.held === null) return;
      this.arm(closed);
      headset.say(this.armed ? "the robot follows" : "close your other hand too, and the robot follows");
    };
    const release = (): void => {
      this.release();
      this.arm(false);
      headset.say("");
    };
    second(false);
    return { release, second };
  }

  /** Shows the answer of the server, and the reachable shape. */
  answered(reach: Reach, ghost: Float32Array | null = null): void {
    this.heard = reach;
    if (!this.enabled || reach === this.shown) return;
    this.shown = reach;
    if (!this.refused) this.tell(reach.text, reach.status, reach.inputs.map((i) => `${i.name} ${amount(i.value, i.unit)}`.replaceAll(" ", "\u00a0")).join(" · "));
    element("arm").dataset.moving = String(reach.armed);
    if (ghost && this.subject) {
      poseBones(this.reachable().bones, ghost);
      this.reachable().root.visible = true;
    }
    this.stage.touch();
  }

  private reachable(): { root: ReturnType<typeof clone>; bones: Bone[] } {
    if (this.twin) return this.twin;
    const root = clone(this.subject!.body.gltf.scene);
    const bones: Bone[] = [];
    root.traverse((node) => {
      if (!(node instanceof SkinnedMesh)) return;
      node.material = new MeshStandardMaterial({ color: new Color(0x7df0c0), transparent: true, opacity: 0.32, depthWrite: false, roughness: 0.6 });
      node.castShadow = node.receiveShadow = false;
      node.frustumCulled = false;
      bones.push(...node.skeleton.bones);
    });
    this.subject!.body.group.add(root);
    this.twin = { root, bones };
    return this.twin;
  }

  private arm(on: boolean): void {
    if (on && this.held === null) this.open(); // after a stop the hand must be opened first
    if (on && this.refused) {
      this.refused = false;
      this.tell(HINT, "", "");
    }
    this.armed = on && this.subject?.commands === true;
    const button = element("arm");
    button.setAttribute("aria-pressed", String(this.armed));
    button.textContent = this.armed ? "Disarm" : "Arm the robot";
  }

  private grab(event: PointerEvent): void {
    if (!this.enabled || !this.subject || event.button !== 0) return;
    const canvas = this.stage.renderer.domElement;
    this.aim(event);
    const [hit] = this.ray.intersectObjects(this.balls, false);
    const index = hit ? this.balls.indexOf(hit.object as Mesh) : event.pointerType === "touch" ? this.near(event) : null;
    if (index === null) return;
    event.stopImmediatePropagation();
    canvas.setPointerCapture(event.pointerId);
    this.stage.controls.enabled = false;
    this.begin(index);
  }

  /** Returns the handle under a finger, whose contact is larger than the ball. */
  private near(event: PointerEvent): number | null {
    const { left, top, width, height } = this.stage.renderer.domElement.getBoundingClientRect();
    const away = this.balls.map((ball) => {
      const at = ball.getWorldPosition(new Vector3()).project(this.stage.camera);
      return Math.hypot(left + (width * (at.x + 1)) / 2 - event.clientX, top + (height * (1 - at.y)) / 2 - event.clientY);
    });
    return closest(away, FINGER);
  }

  private begin(index: number): void {
    this.refused = false;
    this.held = this.chosen = index;
    this.balls[index]!.getWorldPosition(this.wish);
    this.plane.setFromNormalAndCoplanarPoint(this.stage.camera.getWorldDirection(new Vector3()).negate(), this.wish);
    this.target.visible = this.line.visible = true;
    this.choices();
  }

  private move(event: PointerEvent): void {
    if (this.held === null || !this.stage.renderer.domElement.hasPointerCapture(event.pointerId)) return;
    this.aim(event);
    this.ray.ray.intersectPlane(this.plane, this.wish);
    this.stage.touch();
  }

  private release(): void {
    if (this.held === null) return;
    this.held = null;
    this.refused = false;
    this.open();
    this.stage.controls.enabled = true;
    this.line.visible = this.target.visible = false;
    this.stage.touch();
  }

  /** Shift and arrow keys move the selected point in the image plane. */
  private key(event: KeyboardEvent): void {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (!this.enabled || !this.subject || !event.shiftKey || !way) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    if (this.held === null) this.begin(this.chosen);
    const step = STEP * this.subject.body.size;
    const right = new Vector3().setFromMatrixColumn(this.stage.camera.matrixWorld, 0);
    const up = new Vector3().setFromMatrixColumn(this.stage.camera.matrixWorld, 1);
    this.wish.addScaledVector(right, step * way[0]!).addScaledVector(up, step * way[1]!);
    this.say();
  }

  private aim(event: PointerEvent): void {
    const { left, top, width, height } = this.stage.renderer.domElement.getBoundingClientRect();
    const at = new Vector2((2 * (event.clientX - left)) / width - 1, 1 - (2 * (event.clientY - top)) / height);
    this.ray.setFromCamera(at, this.stage.camera);
  }

  private draw(): void {
    const from = this.balls[this.held!]!.getWorldPosition(new Vector3());
    this.line.geometry.setFromPoints([from, this.wish]);
    this.target.position.copy(this.wish);
    this.target.scale.setScalar(0.012 * this.subject!.body.size);
    this.stage.touch();
  }

  private choices(): void {
    const names = (this.subject?.handles ?? []).map((handle) => handle.name);
    element("handle-choice").hidden = names.length < 2;
    element<HTMLSelectElement>("handles").replaceChildren(...names.map((name, i) => new Option(name, name, false, i === this.chosen)));
    element("handle-count").textContent = `of ${names.length}`;
  }
}

/** Returns the index of the smallest distance, or null if none is below a limit. */
function closest(distances: number[], limit: number): number | null {
  const best = distances.reduce((b, d, i) => (d < distances[b]! ? i : b), 0);
  return distances.length && distances[best]! < limit ? best : null;
}
