// The room around the robot: light, ground, camera, and the way into a headset.

import {
  ACESFilmicToneMapping,
  Box3,
  DirectionalLight,
  Fog,
  GridHelper,
  Group,
  HemisphereLight,
  LineBasicMaterial,
  Matrix4,
  Mesh,
  MeshBasicMaterial,
  PCFShadowMap,
  PerspectiveCamera,
  PlaneGeometry,
  PMREMGenerator,
  RingGeometry,
  Scene,
  ShadowMaterial,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { RoomEnvironment } from "three/addons/environments/RoomEnvironment.js";

const TABLE = new Vector3(0, 1.1, -0.6); // where the robot's ground stands in front of a person [m]

const FIELD_OF_VIEW = 38; // on a screen [deg]

export class Stage {
  readonly scene = new Scene();
  readonly camera = new PerspectiveCamera(FIELD_OF_VIEW, 1, 0.001, 100);
  readonly renderer: WebGLRenderer;
  readonly controls: OrbitControls;
  /** Everything that belongs to the robot; moves as one onto the table of a headset's room. */
  readonly robot = new Group();
  private readonly ground = new Group();
  private readonly sun = new DirectionalLight(0xfff2e0, 2.6);
  private readonly reticle = new Mesh(
    new RingGeometry(0.06, 0.075, 40).rotateX(-Math.PI / 2),
    new MeshBasicMaterial({ color: 0x5aa9ff, transparent: true, opacity: 0.9 }),
  );
  private hits: XRHitTestSource | null = null;
  private anchor: XRAnchor | null = null;
  private dirty = true;
  private box = new Box3();

  constructor(private readonly canvas: HTMLCanvasElement) {
    this.renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.toneMapping = ACESFilmicToneMapping;
    this.renderer.toneMappingExposure = 1.05;
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = PCFShadowMap;
    this.renderer.xr.enabled = true;
    const room = new PMREMGenerator(this.renderer);
    this.scene.environment = room.fromScene(new RoomEnvironment(), 0.04).texture;
    this.scene.environmentIntensity = 0.45;
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(2048, 2048);
    this.sun.shadow.radius = 4;
    this.sun.shadow.bias = -0.0004;
    this.robot.add(this.sun, this.sun.target, this.ground);
    this.reticle.matrixAutoUpdate = false;
    this.reticle.visible = false;
    this.scene.add(this.reticle, this.robot, new HemisphereLight(0xbfd8ff, 0x1a1f28, 0.7));
    this.renderer.xr.addEventListener("sessionend", () => this.leave());
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = true;
    this.controls.dampingFactor = 0.12;
    this.controls.addEventListener("change", () => this.touch());
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
  }

  /** Fits ground, light and camera to the space that the body needs during the run, in glTF's frame [m]. */
  fit(box: Box3): void {
    this.box = box.clone();
    const size = box.getSize(new Vector3()).length() || 1;
    const middle = box.getCenter(new Vector3());
    this.layGround(size, middle, box.min.y - 0.002 * size);
    this.sun.position.copy(middle).add(new Vector3(0.6, 1.4, 0.8).multiplyScalar(1.4 * size));
    this.sun.target.position.copy(middle);
    const shadow = this.sun.shadow.camera;
    shadow.left = shadow.bottom = -1.1 * size;
    shadow.right = shadow.top = 1.1 * size;
    shadow.near = 0.1 * size;
    shadow.far = 6 * size;
    shadow.updateProjectionMatrix();
    this.sun.shadow.normalBias = 0.003 * size;
    this.camera.near = size / 100;
    this.camera.far = size * 60;
    this.controls.minDistance = 0.15 * size;
    this.controls.maxDistance = 8 * size;
    this.scene.fog = new Fog(0x111823, 3.5 * size, 9 * size);
    this.lookFromStart();
  }

  lookFromStart(): void {
    const size = this.box.getSize(new Vector3()).length() || 1;
    const middle = this.box.getCenter(new Vector3());
    const narrow = Math.min(1, this.camera.aspect);
    const distance = (0.5 * size) / Math.tan((this.camera.fov * Math.PI) / 360) / Math.max(0.45, narrow);
    this.controls.target.copy(middle);
    this.camera.position.copy(middle).add(new Vector3(0.62, 0.42, 0.85).normalize().multiplyScalar(distance));
    this.camera.updateProjectionMatrix();
    this.controls.update();
    this.touch();
  }

  showGround(visible: boolean): void {
    this.ground.visible = visible;
    this.touch();
  }

  touch(): void {
    this.dirty = true;
  }

  /** Calls step(seconds) before every picture; draws only where something has changed. */
  run(step: (seconds: number) => void): void {
    let before = performance.now();
    this.renderer.setAnimationLoop((now: number, frame?: XRFrame) => {
      const seconds = Math.min(0.1, Math.max(0, (now - before) / 1000));
      before = now;
      step(seconds);
      if (frame) this.lookAround(frame);
      if (!this.renderer.xr.isPresenting) this.controls.update();
      if (!this.dirty && !this.renderer.xr.isPresenting) return;
      this.dirty = false;
      this.renderer.render(this.scene, this.camera);
    });
  }

  /** Enters a headset. In VR the robot stands in its true size on a table; in AR it goes where the person points and selects. */
  async enter(mode: XRSessionMode): Promise<void> {
    const xr = navigator.xr;
    if (!xr) return;
    const session = await xr.requestSession(mode, { optionalFeatures: ["local-floor", "hand-tracking", "hit-test", "anchors"] });
    this.renderer.xr.setReferenceSpaceType(session.enabledFeatures?.includes("local-floor") === false ? "local" : "local-floor");
    this.stand(new Matrix4().setPosition(TABLE));
    this.scene.fog = null;
    await this.renderer.xr.setSession(session);
    if (mode === "immersive-ar") await this.seekSurfaces(session);
  }

  /** Puts the middle of the robot's ground at a pose of the room. */
  private stand(pose: Matrix4): void {
    const middle = this.box.getCenter(new Vector3());
    pose.decompose(this.robot.position, this.robot.quaternion, this.robot.scale);
    this.robot.position.sub(new Vector3(middle.x, this.box.min.y, middle.z).applyQuaternion(this.robot.quaternion));
  }

  /** Follows the surfaces that the device sees; a selection puts the robot there and keeps it there. */
  private async seekSurfaces(session: XRSession): Promise<void> {
    const space = await session.requestReferenceSpace("viewer");
    this.hits = (await session.requestHitTestSource?.({ space })) ?? null;
    session.addEventListener("select", (event) => {
      if (!this.reticle.visible) return;
      this.stand(this.reticle.matrix);
      this.keep(event.frame);
    });
  }

  private lookAround(frame: XRFrame): void {
    const space = this.renderer.xr.getReferenceSpace();
    if (!space) return;
    const kept = this.anchor && frame.trackedAnchors?.has(this.anchor) ? frame.getPose(this.anchor.anchorSpace, space) : null;
    if (kept) this.stand(new Matrix4().fromArray(kept.transform.matrix));
    const seen = this.hits ? frame.getHitTestResults(this.hits)[0]?.getPose(space) : null;
    this.reticle.visible = Boolean(seen);
    if (seen) this.reticle.matrix.fromArray(seen.transform.matrix);
  }

  /** Asks the device to hold the place even where it corrects its own position; devices without anchors go on as they are. */
  private keep(frame: XRFrame): void {
    const space = this.renderer.xr.getReferenceSpace();
    const seen = this.hits ? frame.getHitTestResults(this.hits)[0] : null;
    if (!space || !seen?.createAnchor) return;
    this.anchor?.delete();
    this.anchor = null;
    seen.createAnchor()?.then(
      (anchor) => (this.anchor = anchor),
      () => undefined,
    );
  }

  /** Height of the view in pixels; 0 in a headset. */
  get pixelHeight(): number {
    return this.renderer.xr.isPresenting ? 0 : this.canvas.clientHeight;
  }

  private leave(): void {
    this.robot.position.set(0, 0, 0);
    this.robot.quaternion.identity();
    this.reticle.visible = false;
    this.hits = this.anchor = null;
    this.camera.fov = FIELD_OF_VIEW; // the session left the headset's
    this.camera.zoom = 1;
    this.resize();
    this.fit(this.box);
  }

  private layGround(size: number, middle: Vector3, height: number): void {
    this.ground.clear();
    const step = 10 ** Math.floor(Math.log10(size / 3)); // 1 cm, 10 cm, 1 m …
    const half = Math.ceil((2.5 * size) / step) * step;
    for (const [cell, color, opacity] of [
      [step, 0x8fb3e0, 0.09],
      [5 * step, 0xa9c8f0, 0.16],
    ] as const) {
      const count = Math.max(2, 2 * Math.round(half / cell));
      const lines = new GridHelper(count * cell, count, color, color);
      const paint = lines.material as LineBasicMaterial;
      paint.transparent = true;
      paint.opacity = opacity;
      paint.depthWrite = false;
      lines.position.set(Math.round(middle.x / cell) * cell, height, Math.round(middle.z / cell) * cell);
      this.ground.add(lines);
    }
    const floor = new Mesh(new PlaneGeometry(2 * half, 2 * half), new ShadowMaterial({ opacity: 0.38 }));
    floor.rotation.x = -Math.PI / 2;
    floor.position.set(middle.x, height - 0.0005 * size, middle.z);
    floor.receiveShadow = true;
    this.ground.add(floor);
  }

  private resize(): void {
    if (this.renderer.xr.isPresenting) return;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.camera.aspect = width / height;
    if (width < 700 && height > width) this.camera.setViewOffset(width, height, 0, Math.round(-0.07 * height), width, height);
    else this.camera.clearViewOffset(); // on a phone the panel takes the upper part
    this.camera.updateProjectionMatrix();
    this.renderer.setSize(width, height, false);
    this.touch();
  }
}
