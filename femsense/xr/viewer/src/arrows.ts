// Contact forces as arrows that end at the contact point. Uncertainty is shown in a pale colour: a collar at the tail (magnitude), a cone
// around the shaft (direction), an ellipsoid at the tip (position); each shows ± one standard deviation.

import {
  CanvasTexture,
  ConeGeometry,
  CylinderGeometry,
  DoubleSide,
  GreaterDepth,
  Group,
  Mesh,
  MeshBasicMaterial,
  MeshStandardMaterial,
  Quaternion,
  SphereGeometry,
  Sprite,
  SpriteMaterial,
  SRGBColorSpace,
  Vector3,
  type Box2,
  type Camera,
} from "three";
import { newtons, type Contact, type Vector } from "./data";

const COLORS = { "": 0xff9c33, doubtful: 0xa08a70, stale: 0x7d838c };
const COLOR = COLORS[""];
type Doubt = keyof typeof COLORS;
const UP = new Vector3(0, 1, 0);
const LONGEST = 0.42; // length of the longest arrow, relative to the body's size
const NOISE = 3; // significance threshold in standard deviations: forces below it get no long arrow
const HANGING = [0.5, -0.25] as const; // offset of a label above its point
const LABEL_HEIGHT = 0.046; // relative to the distance from the viewer

export class ForceArrows {
  /** In the robot's frame. */
  readonly group = new Group();
  /** Largest force so far [N]. */
  largest = 1e-9;
  /** Force of the longest arrow at present [N]. */
  full = 1e-9;
  private arrows: Arrow[] = [];
  private doubt: Doubt = "";

  /** size: of the body [m]. */
  constructor(private readonly size: number) {}

  /** Desaturates forces that are stale or not reliable. */
  tell(doubt: Doubt): void {
    this.doubt = doubt;
    for (const arrow of this.arrows) arrow.tell(doubt);
  }

  show(contacts: Contact[]): void {
    for (const c of contacts) this.largest = Math.max(this.largest, c.force_n ?? 0);
    this.full = Math.max(this.largest, ...contacts.map((c) => NOISE * (c.std_n ?? 0)));
    const placed = contacts.filter((c) => c.point_m && c.force_vector_n && c.force_n !== null && c.force_n > 0);
    while (this.arrows.length < placed.length) {
      const arrow = new Arrow(this.size);
      arrow.tell(this.doubt);
      this.arrows.push(arrow);
      this.group.add(arrow.group);
    }
    this.arrows.forEach((arrow, i) => arrow.set(placed[i], (LONGEST * this.size) / this.full));
  }

  /** Returns the tails of the arrows, in glTF's frame (Y up). */
  ends(contacts: Contact[]): Vector3[] {
    const placed = contacts.filter((c) => c.point_m && c.force_vector_n);
    return placed.map((c) => {
      const [x, y, z] = new Vector3(...c.point_m!).addScaledVector(new Vector3(...c.force_vector_n!), (-LONGEST * this.size) / this.full).toArray();
      return new Vector3(x, z, -y);
    });
  }

  /** Keeps labels readable: scales them with the distance from the viewer, and keeps them between the panels. */
  face(camera: Camera, height: number, room: Box2 | null): void {
    for (const arrow of this.arrows) arrow.face(camera, height, room);
  }
}

class Arrow {
  readonly group = new Group();
  private readonly shaft: Mesh;
  private readonly head: Mesh;
  private readonly collar: Mesh;
  private readonly cone: Mesh;
  private readonly place: Mesh;
  private readonly label = new Label();
  private readonly radius: number;
  private readonly paints: (MeshStandardMaterial | MeshBasicMaterial)[];

  constructor(size: number) {
    this.radius = 0.0085 * size;
    const paint = new MeshStandardMaterial({ color: COLOR, roughness: 0.55, envMapIntensity: 0.3 });
    const behind = new MeshBasicMaterial({ color: COLOR, transparent: true, opacity: 0.3, depthFunc: GreaterDepth, depthWrite: false });
    const pale = new MeshBasicMaterial({ color: COLOR, transparent: true, opacity: 0.35, depthWrite: false });
    const paler = new MeshBasicMaterial({ color: COLOR, transparent: true, opacity: 0.16, depthWrite: false, side: DoubleSide });
    this.paints = [paint, behind, pale, paler];
    this.shaft = new Mesh(new CylinderGeometry(1, 1, 1, 20).translate(0, -0.5, 0), paint);
    this.head = new Mesh(new ConeGeometry(1, 1, 24).translate(0, -0.5, 0), paint);
    this.collar = new Mesh(new CylinderGeometry(1, 1, 1, 20), pale);
    this.cone = new Mesh(new ConeGeometry(1, 1, 32, 1, true).translate(0, -0.5, 0), paler); // with its apex at the tip of the arrow
    this.place = new Mesh(new SphereGeometry(1, 20, 14), paler);
    for (const part of [this.shaft, this.head]) {
      part.castShadow = true;
      part.add(new Mesh(part.geometry, behind)); // visible through the body
    }
    const point = new Mesh(new SphereGeometry(0.6 * this.radius, 16, 12), new MeshBasicMaterial({ color: 0xffffff }));
    this.group.add(this.shaft, this.head, this.collar, this.cone, this.place, point, this.label.sprite);
  }

  tell(doubt: Doubt): void {
    for (const paint of this.paints) paint.color.set(COLORS[doubt]);
  }

  set(contact: Contact | undefined, metresPerNewton: number): void {
    this.group.visible = contact !== undefined;
    if (!contact) return;
    const force = new Vector3(...contact.force_vector_n!);
    const length = Math.max(force.length() * metresPerNewton, 1e-6);
    this.group.position.set(...contact.point_m!);
    this.group.quaternion.copy(new Quaternion().setFromUnitVectors(UP, force.clone().normalize()));
    const head = Math.min(5 * this.radius, 0.6 * length);
    this.head.scale.set(2.4 * this.radius, head, 2.4 * this.radius);
    this.shaft.position.y = -0.9 * head;
    this.shaft.scale.set(this.radius, Math.max(length - 0.9 * head, 1e-6), this.radius);
    const spread = 2 * (contact.std_n ?? 0) * metresPerNewton;
    this.collar.visible = spread > 0;
    this.collar.position.y = -length;
    this.collar.scale.set(1.9 * this.radius, Math.max(spread, 1e-6), 1.9 * this.radius);
    const aside = sideways(force, contact.force_std_n) * metresPerNewton;
    this.cone.visible = aside > 0.2 * this.radius;
    this.cone.scale.set(aside, length, aside);
    const [x, y, z] = contact.point_std_m ?? [0, 0, 0];
    this.place.visible = Math.max(x, y, z) > 0.3 * this.radius;
    this.place.quaternion.copy(this.group.quaternion).invert(); // aligned with the robot's axes
    this.place.scale.set(Math.max(x, 1e-6), Math.max(y, 1e-6), Math.max(z, 1e-6));
    this.label.sprite.position.y = -length;
    this.label.write(newtons(contact.force_n, contact.std_n));
  }

  face(camera: Camera, height: number, room: Box2 | null): void {
    this.label.scaleTo(camera, height);
    this.label.keepIn(camera, room);
  }
}

/** Standard deviation of a force transverse to its direction [N]: the root mean square of the two components. */
function sideways(force: Vector3, std: Vector | null): number {
  if (!std) return 0;
  const along = force.clone().normalize();
  const total = std[0] ** 2 + std[1] ** 2 + std[2] ** 2;
  const inLine = (std[0] * along.x) ** 2 + (std[1] * along.y) ** 2 + (std[2] * along.z) ** 2;
  return Math.sqrt(Math.max(0, total - inLine) / 2);
}

function between(low: number, value: number, high: number): number {
  return Math.max(low, Math.min(high, value));
}

export class Label {
  readonly sprite: Sprite;
  private readonly canvas = document.createElement("canvas");
  private readonly texture: CanvasTexture;
  private text = "";
  private share = 1; // share of the texture's width with text

  constructor() {
    this.canvas.width = 512;
    this.canvas.height = 96;
    this.texture = new CanvasTexture(this.canvas);
    this.texture.colorSpace = SRGBColorSpace;
    this.sprite = new Sprite(new SpriteMaterial({ map: this.texture, depthTest: false, transparent: true, toneMapped: false }));
    this.sprite.center.set(...HANGING);
    this.sprite.renderOrder = 10;
  }

  write(text: string): void {
    if (text === this.text) return;
    this.text = text;
    const pen = this.canvas.getContext("2d")!;
    const { width, height } = this.canvas;
    pen.clearRect(0, 0, width, height);
    pen.font = '600 52px system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif';
    const half = Math.min(width, pen.measureText(text).width + 52) / 2;
    this.share = (2 * half) / width;
    pen.fillStyle = "rgb(13 17 23 / 82%)";
    pen.beginPath();
    pen.roundRect(width / 2 - half, 4, 2 * half, height - 8, 28);
    pen.fill();
    pen.fillStyle = "#ffd9a3";
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.fillText(text, width / 2, height / 2 + 3, width - 30);
    this.texture.needsUpdate = true;
  }

  /** pixels: height of the view; labels keep about 30 of them. 0 in a headset. */
  scaleTo(camera: Camera, pixels: number): void {
    const distance = camera.getWorldPosition(new Vector3()).distanceTo(this.sprite.getWorldPosition(new Vector3()));
    const share = pixels > 0 ? Math.min(LABEL_HEIGHT, 21 / pixels) : LABEL_HEIGHT;
    const height = share * distance;
    const parent = this.sprite.parent!.getWorldScale(new Vector3()).x;
    this.sprite.scale.set((height * this.canvas.width) / this.canvas.height / parent, height / parent, 1);
  }

  /** Moves the label into a part of the image, in coordinates −1 … 1; null: it stays above its point. */
  keepIn(camera: Camera, room: Box2 | null): void {
    this.sprite.center.set(...HANGING);
    if (!room || !this.sprite.visible) return;
    const place = this.sprite.getWorldPosition(new Vector3());
    const parent = this.sprite.parent!.getWorldScale(new Vector3()).x;
    const depth = -place.clone().applyMatrix4(camera.matrixWorldInverse).z;
    const projection = camera.projectionMatrix.elements;
    const width = (this.sprite.scale.x * parent * projection[0]!) / depth;
    const height = (this.sprite.scale.y * parent * projection[5]!) / depth;
    place.project(camera);
    const { center } = this.sprite;
    const half = this.share / 2;
    center.x = between(0.5 + half - (room.max.x - place.x) / width, center.x, 0.5 - half + (place.x - room.min.x) / width);
    center.y = between(1 - (room.max.y - place.y) / height, center.y, (place.y - room.min.y) / height);
  }
}
