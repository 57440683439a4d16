// The scene around the robot: light, ground, camera.

import {
  ACESFilmicToneMapping,
  Box2,
  Box3,
  DirectionalLight,
  Fog,
  GridHelper,
  Group,
  HemisphereLight,
  LineBasicMaterial,
  Mesh,
  PCFShadowMap,
  PerspectiveCamera,
  PlaneGeometry,
  PMREMGenerator,
  Scene,
  ShadowMaterial,
  Vector2,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { RoomEnvironment } from "three/addons/environments/RoomEnvironment.js";
import { niceLength } from "./body";
import { Headset } from "./headset";
import { Measures } from "./measures";

const FIELD_OF_VIEW = 38; // on a screen [deg]
const WIDEST = 10; // maximum growth of the view: objects farther away are not robots
const FROM = new Vector3(0.62, 0.42, 0.85).normalize(); // initial direction of the camera

/** Margins of the image covered by panels and bar [px], as in style.css. */
function free(width: number, height: number): { left: number; right: number; top: number; bottom: number } {
  const tabs = document.querySelector("#robots:not([hidden])") ? 50 : 0;
  const tall = (id: string): number => document.querySelector<HTMLElement>(`#${id}:not([hidden])`)?.offsetHeight ?? 0;
  if (width <= 820 && height > 480) {
    const dragging = tall("dragging");
    return { left: 10, right: 10, top: 80 + tabs + (dragging ? 60 : 0.3 * height), bottom: 24 + tall("dock") + dragging + tall("measures") };
  }
  const left = tall("dragging") && width > 1000 ? 380 : 20;
  return { left, right: height > 480 ? 310 : 290, top: 70, bottom: 36 + tall("dock") };
}

export class Stage {
  readonly scene = new Scene();
  readonly camera = new PerspectiveCamera(FIELD_OF_VIEW, 1, 0.001, 100);
  readonly renderer: WebGLRenderer;
  readonly controls: OrbitControls;
  readonly headset: Headset;
  /** All objects of the robot; moved as a whole in a headset session. */
  readonly robot = new Group();
  private readonly ground = new Group();
  private readonly sun = new DirectionalLight(0xfff2e0, 2.6);
  private dirty = true;
  private box = new Box3();
  private floor = 0; // height of the ground, in glTF's frame [m]
  private readonly measures = new Measures();
  private moved = false; // by the user

  constructor(private readonly canvas: HTMLCanvasElement) {
    this.renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.toneMapping = ACESFilmicToneMapping;
    this.renderer.toneMappingExposure = 1.05;
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = PCFShadowMap;
    this.renderer.shadowMap.autoUpdate = false; // in a headset every image is drawn, and few of them change the shadow
    this.renderer.xr.enabled = true;
    const room = new PMREMGenerator(this.renderer);
    this.scene.environment = room.fromScene(new RoomEnvironment(), 0.04).texture;
    this.scene.environmentIntensity = 0.45;
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(2048, 2048);
    this.sun.shadow.radius = 4;
    this.sun.shadow.bias = -0.0004;
    this.robot.add(this.sun, this.sun.target, this.ground);
    this.scene.add(this.robot, new HemisphereLight(0xbfd8ff, 0x1a1f28, 0.7));
    this.headset = new Headset(this);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = true;
    this.controls.dampingFactor = 0.12;
    this.controls.addEventListener("change", () => this.touch());
    this.controls.addEventListener("start", () => (this.moved = true));
    const observer = new ResizeObserver(() => this.resize());
    for (const one of [canvas, document.getElementById("dock")!]) observer.observe(one);
    this.resize();
  }

  /** Fits ground, light and camera to the space that the body needs, in glTF's frame [m]; it stands on the floor, which is the lowest
   * that the body itself is. */
  fit(box: Box3, floor = this.floor): void {
    this.box = box.clone();
    this.floor = floor;
    this.headset.fit(box);
    const size = box.getSize(new Vector3()).length() || 1;
    const middle = box.getCenter(new Vector3());
    this.layGround(size, middle, floor);
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
    this.scene.fog = this.headset.presenting ? null : new Fog(0x111823);
    this.lookFromStart();
  }

  /** Zooms out if an object lies outside the fitted view, unless the user has chosen the view. */
  include(box: Box3): void {
    if (this.moved || this.headset.presenting || box.isEmpty() || this.box.containsBox(box)) return;
    const wider = this.box.clone().union(box);
    const size = wider.getSize(new Vector3()).length();
    if (size < WIDEST * this.box.getSize(new Vector3()).length()) this.fit(wider.expandByScalar(0.03 * size)); // with a margin, to avoid frequent changes
  }

  lookFromStart(): void {
    this.moved = false;
    if (this.box.isEmpty()) return;
    const middle = this.box.getCenter(new Vector3());
    const [size, away] = [this.box.getSize(new Vector3()).length() || 1, this.distance(middle)];
    if (this.scene.fog instanceof Fog) [this.scene.fog.near, this.scene.fog.far] = [away + 1.5 * size, away + 7 * size]; // behind it all
    this.controls.maxDistance = Math.max(8 * size, 2 * away);
    this.controls.target.copy(middle);
    this.camera.position.copy(middle).addScaledVector(FROM, away);
    this.camera.updateProjectionMatrix();
    this.controls.update();
    this.touch();
  }

  /** Distance at which the camera sees the whole box between the panels [m]. */
  private distance(middle: Vector3): number {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const { left, right, top, bottom } = free(width, height);
    const up = Math.tan((this.camera.fov * Math.PI) / 360) * Math.max(0.2, 1 - (top + bottom) / (height || 1));
    const aside = Math.tan((this.camera.fov * Math.PI) / 360) * this.camera.aspect * Math.max(0.2, 1 - (left + right) / (width || 1));
    const [x, y] = [new Vector3(0, 1, 0).cross(FROM).normalize(), new Vector3()];
    y.crossVectors(FROM, x);
    const corner = new Vector3();
    let distance = 0;
    for (let i = 0; i < 8; i++) {
      corner.set(this.box[i & 1 ? "max" : "min"].x, this.box[i & 2 ? "max" : "min"].y, this.box[i & 4 ? "max" : "min"].z).sub(middle);
      distance = Math.max(distance, corner.dot(FROM) + Math.max(Math.abs(corner.dot(x)) / aside, Math.abs(corner.dot(y)) / up));
    }
    return distance || 1;
  }

  showGround(visible: boolean): void {
    this.ground.visible = visible;
    this.touch();
  }

  touch(): void {
    this.dirty = true;
  }

  /** Calls step(seconds) before every image; draws only after changes. */
  run(step: (seconds: number) => void): void {
    let before = performance.now();
    this.renderer.setAnimationLoop((now: number, frame?: XRFrame) => {
      const seconds = Math.min(0.1, Math.max(0, (now - before) / 1000));
      before = now;
      if (frame) this.headset.step(frame);
      step(seconds);
      if (!this.renderer.xr.isPresenting) this.controls.update();
      if (!this.dirty && !this.renderer.xr.isPresenting) return;
      this.renderer.shadowMap.needsUpdate = this.dirty;
      this.dirty = false;
      this.renderer.render(this.scene, this.camera);
      if (!this.renderer.xr.isPresenting) this.measures.follow(this.camera, this.robot, this.pixelsPerMetre());
    });
  }

  /** Height of the view in pixels; 0 in a headset. */
  get pixelHeight(): number {
    return this.renderer.xr.isPresenting ? 0 : this.canvas.clientHeight;
  }

  /** Pixels per metre at the centre of rotation. */
  private pixelsPerMetre(): number {
    const away = this.camera.position.distanceTo(this.controls.target);
    return this.canvas.clientHeight / (2 * away * Math.tan((this.camera.fov * Math.PI) / 360)) || 1;
  }

  /** The part of the image not covered by panels, in coordinates −1 … 1; null in a headset. */
  get room(): Box2 | null {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (this.renderer.xr.isPresenting || !width || !height) return null;
    const { left, right, top, bottom } = free(width, height);
    return new Box2(new Vector2((2 * left) / width - 1, (2 * bottom) / height - 1), new Vector2(1 - (2 * right) / width, 1 - (2 * top) / height));
  }

  /** Adapts the view to opened and closed panels. */
  panelsChanged(): void {
    this.resize();
  }

  /** Restores the view of the screen after a headset session. */
  restore(): void {
    this.camera.fov = FIELD_OF_VIEW; // the session leaves that of the headset
    this.camera.zoom = 1;
    this.resize();
    this.fit(this.box);
  }

  private layGround(size: number, middle: Vector3, height: number): void {
    this.ground.clear();
    const step = niceLength(size / 14); // 1 cm, 2 cm, 5 cm …
    const half = Math.ceil((2.5 * size) / step) * step;
    this.measures.grid(step);
    for (const [cell, color, opacity] of [
      [step, 0x8fb3e0, 0.12],
      [5 * step, 0xa9c8f0, 0.2],
    ] as const) {
      const count = Math.max(2, 2 * Math.round(half / cell));
      const lines = new GridHelper(count * cell, count, color, color);
      const paint = lines.material as LineBasicMaterial;
      paint.transparent = true;
      paint.opacity = opacity;
      paint.depthWrite = false;
      lines.position.set(Math.round(middle.x / cell) * cell, height - 0.001 * size, Math.round(middle.z / cell) * cell);
      this.ground.add(lines);
    }
    const floor = new Mesh(new PlaneGeometry(2 * half, 2 * half), new ShadowMaterial({ opacity: 0.5 }));
    floor.rotation.x = -Math.PI / 2;
    floor.position.set(middle.x, height - 0.0015 * size, middle.z);
    floor.receiveShadow = true;
    this.ground.add(floor);
  }

  private resize(): void {
    if (this.renderer.xr.isPresenting) return;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.camera.aspect = width / height;
    const { left, right, top, bottom } = free(width, height);
    this.camera.setViewOffset(width, height, (right - left) / 2, (bottom - top) / 2, width, height);
    this.camera.updateProjectionMatrix();
    this.renderer.setSize(width, height, false);
    if (!this.moved) this.lookFromStart(); // a rotated phone
    this.touch();
  }
}
