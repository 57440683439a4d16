// Headset sessions: the robot on a table or on a detected surface, moved by controllers and hands, or aligned with the real robot.

import { Box3, BufferGeometry, Line, LineBasicMaterial, Matrix4, Mesh, MeshBasicMaterial, Object3D, Ray, RingGeometry, Vector3, type Group } from "three";
import type { Alignment } from "./alignment";
import { Label } from "./arrows";
import type { Stage } from "./stage";

const TABLE = new Vector3(0, 1.1, -0.6); // position of the robot's ground in front of the user [m]
const REACH = 3; // length of the pointing ray of a controller [m]

/** A hand or a controller: its pointing ray, and its touching point. */
export class Hand {
  readonly ray = new Ray();
  readonly point = new Vector3();

  constructor(
    readonly pointer: Group,
    private readonly joints: Group & { joints?: Record<string, Object3D | undefined> },
  ) {}

  /** Updates ray and point, in world coordinates. */
  update(): void {
    this.pointer.updateWorldMatrix(true, false);
    this.ray.origin.setFromMatrixPosition(this.pointer.matrixWorld);
    this.ray.direction.set(0, 0, -1).transformDirection(this.pointer.matrixWorld);
    const [finger, thumb] = [this.joints.joints?.["index-finger-tip"], this.joints.joints?.["thumb-tip"]];
    if (!finger?.visible || !thumb?.visible) this.point.copy(this.ray.origin);
    else this.point.copy(finger.getWorldPosition(new Vector3())).add(thumb.getWorldPosition(new Vector3())).multiplyScalar(0.5);
  }
}

/** A held object, which follows the hand until it is released. */
export interface Hold {
  follow(): void;
  release(): void;
  /** The other hand closes or opens: with both hands closed the robot follows. Without this method, the other hand holds another object. */
  second?: (closed: boolean) => void;
}

/** Attaches a point of the world to a hand; returns a function of its current position. */
export function tied(hand: Hand, place: Matrix4): () => Matrix4 {
  const offset = hand.pointer.matrixWorld.clone().invert().multiply(place);
  return () => hand.pointer.matrixWorld.clone().multiply(offset);
}

export class Headset {
  /** Called first when a hand closes; null if nothing is grabbed. */
  grab: (hand: Hand) => Hold | null = () => null;
  /** Called at the beginning and the end of a session. */
  changed: (presenting: boolean) => void = () => undefined;
  /** While it is set, selections of a hand are points of the real robot. */
  alignment: Alignment | null = null;
  private readonly hands: Hand[] = [];
  private readonly holds: (Hold | null)[] = [null, null];
  private readonly reticle = new Mesh(
    new RingGeometry(0.06, 0.075, 40).rotateX(-Math.PI / 2),
    new MeshBasicMaterial({ color: 0x5aa9ff, transparent: true, opacity: 0.9 }),
  );
  private hits: XRHitTestSource | null = null;
  private anchor: XRAnchor | null = null;
  private placing = false; // a selection requests an anchor in the next frame
  private box = new Box3();

  private readonly words = new Label();

  constructor(private readonly stage: Stage) {
    this.words.sprite.visible = false;
    stage.scene.add(this.words.sprite);
    this.reticle.matrixAutoUpdate = false;
    this.reticle.visible = false;
    stage.scene.add(this.reticle);
    stage.renderer.xr.addEventListener("sessionend", () => this.left());
    for (const index of [0, 1]) this.connect(index);
  }

  get presenting(): boolean {
    return this.stage.renderer.xr.isPresenting;
  }

  /** Whether the page around the image is invisible: in VR, and in AR without a DOM overlay. */
  get alone(): boolean {
    return this.presenting && !this.stage.renderer.xr.getSession()?.domOverlayState;
  }

  /** The bounding box of the robot, in glTF's frame [m]. */
  fit(box: Box3): void {
    this.box = box.clone();
  }

  /** Starts or ends a session. In VR the robot stands in its true size on a table; in AR at the selected place. */
  async toggle(mode: XRSessionMode): Promise<void> {
    const { xr } = this.stage.renderer;
    if (this.presenting) return void (await xr.getSession()?.end());
    if (!navigator.xr) return;
    const session = await navigator.xr.requestSession(mode, {
      optionalFeatures: ["local-floor", "hand-tracking", "hit-test", "anchors", "dom-overlay"],
      domOverlay: { root: document.body },
    } as XRSessionInit);
    xr.setReferenceSpaceType(session.enabledFeatures?.includes("local-floor") === false ? "local" : "local-floor");
    this.stand(new Matrix4().setPosition(TABLE));
    this.stage.scene.fog = null;
    await xr.setSession(session);
    document.documentElement.dataset.xr = mode;
    this.changed(true);
    if (mode === "immersive-ar") await this.seekSurfaces(session);
  }

  /** Shows a text above the robot; none if it is empty. */
  say(text: string): void {
    this.words.write(text);
    this.words.sprite.visible = text !== "";
  }

  /** Called before each image of a session. */
  step(frame: XRFrame): void {
    const space = this.stage.renderer.xr.getReferenceSpace();
    if (!space) return;
    const kept = this.anchor && frame.trackedAnchors?.has(this.anchor) ? frame.getPose(this.anchor.anchorSpace, space) : null;
    if (kept) this.stand(new Matrix4().fromArray(kept.transform.matrix)); // the device may have corrected its tracking
    const hit = this.hits ? frame.getHitTestResults(this.hits)[0] : undefined;
    const seen = hit?.getPose(space) ?? null;
    this.reticle.visible = seen !== null && this.holds.every((hold) => hold === null);
    if (seen) this.reticle.matrix.fromArray(seen.transform.matrix);
    if (this.placing) this.keep(hit);
    this.holds.forEach((hold, i) => {
      this.hands[i]!.update();
      hold?.follow();
    });
    this.alignment?.step();
    const { robot, camera } = this.stage;
    const top = this.box.getCenter(new Vector3()).setY(this.box.max.y);
    this.words.sprite.position.copy(robot.localToWorld(top));
    this.words.scaleTo(camera, 0);
  }

  private connect(index: number): void {
    const { xr } = this.stage.renderer;
    const pointer = xr.getController(index);
    const hand = new Hand(pointer, xr.getHand(index));
    const line = new Line(
      new BufferGeometry().setFromPoints([new Vector3(), new Vector3(0, 0, -REACH)]),
      new LineBasicMaterial({ color: 0x9fc8ff, transparent: true, opacity: 0.35 }),
    );
    pointer.add(line);
    this.hands.push(hand);
    this.stage.scene.add(pointer, xr.getHand(index));
    pointer.addEventListener("connected", (event) => (line.visible = event.data.targetRayMode === "tracked-pointer"));
    pointer.addEventListener("disconnected", () => this.open(index));
    pointer.addEventListener("selectstart", () => this.close(index, true));
    pointer.addEventListener("squeezestart", () => this.close(index, false));
    for (const end of ["selectend", "squeezeend"] as const) pointer.addEventListener(end, () => this.open(index));
    pointer.addEventListener("select", () => this.select(index));
  }

  /** A hand closes: on a handle of the robot, otherwise on the robot itself. */
  private close(index: number, pinch: boolean): void {
    if (this.holds[index] || this.alignment?.open) return;
    const hand = this.hands[index]!;
    hand.update();
    const second = this.holds[1 - index]?.second;
    if (second) {
      second(true);
      this.holds[index] = { follow: () => undefined, release: () => second(false) };
      return;
    }
    this.holds[index] = (pinch ? this.grab(hand) : null) ?? this.carry(hand);
  }

  private open(index: number): void {
    this.holds[index]?.release();
    // "select" precedes "selectend": the held object has not been placed
    this.holds[index] = null;
  }

  private carry(hand: Hand): Hold | null {
    const { robot } = this.stage;
    robot.updateWorldMatrix(true, false);
    const inverse = robot.matrixWorld.clone().invert();
    const near = this.box.clone().expandByScalar(0.02);
    if (!near.containsPoint(hand.point.clone().applyMatrix4(inverse)) && !hand.ray.clone().applyMatrix4(inverse).intersectsBox(near)) return null;
    this.forget();
    const place = tied(hand, robot.matrixWorld);
    const follow = (): void => {
      place().decompose(robot.position, robot.quaternion, robot.scale);
      this.stage.touch();
    };
    return { follow, release: () => undefined };
  }

  private select(index: number): void {
    const hand = this.hands[index]!;
    hand.update();
    if (this.alignment?.open) {
      const place = this.reticle.visible && this.onScreen() ? new Vector3().setFromMatrixPosition(this.reticle.matrix) : hand.point;
      const pose = this.alignment.take(place);
      if (pose) this.lay(pose);
    } else if (this.reticle.visible && !this.holds[index]) {
      this.stand(this.reticle.matrix);
      this.placing = true;
    }
  }

  private onScreen(): boolean {
    return this.stage.renderer.xr.getSession()?.inputSources[0]?.targetRayMode === "screen";
  }

  /** Aligns the twin with the real robot. */
  private lay(pose: Matrix4): void {
    this.forget();
    this.stage.touch();
    const { robot } = this.stage;
    pose.decompose(robot.position, robot.quaternion, robot.scale);
  }

  /** Moves the centre of the robot's ground to a pose in the room. */
  private stand(pose: Matrix4): void {
    this.stage.touch();
    const { robot } = this.stage;
    const middle = this.box.getCenter(new Vector3());
    pose.decompose(robot.position, robot.quaternion, robot.scale);
    robot.position.sub(new Vector3(middle.x, this.box.min.y, middle.z).applyQuaternion(robot.quaternion));
  }

  /** Tracks the surfaces that the device detects. */
  private async seekSurfaces(session: XRSession): Promise<void> {
    try {
      const space = await session.requestReferenceSpace("viewer");
      this.hits = (await session.requestHitTestSource?.({ space })) ?? null;
    } catch {
      this.hits = null; // without hit tests the robot stays in front of the user
    }
  }

  /** Requests an anchor, so that the place is kept when the device corrects its tracking; devices without anchors continue without. */
  private keep(hit: XRHitTestResult | undefined): void {
    this.placing = false;
    this.forget();
    hit?.createAnchor?.()?.then(
      (anchor) => (this.anchor = anchor),
      () => undefined,
    );
  }

  private forget(): void {
    this.anchor?.delete();
    this.anchor = null;
  }

  private left(): void {
    this.holds.forEach((_, i) => this.open(i));
    this.stage.robot.position.set(0, 0, 0);
    this.stage.robot.quaternion.identity();
    this.reticle.visible = this.placing = false;
    this.alignment?.end();
    this.alignment = null;
    this.hits = this.anchor = null;
    delete document.documentElement.dataset.xr;
    this.changed(false);
    this.stage.restore();
  }
}
