// Contact forces as arrows whose tip is the place of contact; a pale collar at the tail shows one standard deviation.

import {
  CanvasTexture,
  ConeGeometry,
  CylinderGeometry,
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
  type Camera,
} from "three";
import { newtons, type Contact } from "./data";

const COLOR = 0xff9c33;
const UP = new Vector3(0, 1, 0);
const LABEL_HEIGHT = 0.046; // of the distance to the viewer

export class ForceArrows {
  /** To be placed in the robot's frame. */
  readonly group = new Group();
  private arrows: Arrow[] = [];

  /** size: of the body [m]; largest: the force that gets the longest arrow [N]. */
  constructor(
    private readonly size: number,
    private readonly largest: number,
  ) {}

  show(contacts: Contact[]): void {
    const placed = contacts.filter((c) => c.point_m && c.force_vector_n && c.force_n !== null && c.force_n > 0);
    while (this.arrows.length < placed.length) {
      const arrow = new Arrow(this.size);
      this.arrows.push(arrow);
      this.group.add(arrow.group);
    }
    this.arrows.forEach((arrow, i) => arrow.set(placed[i], (0.42 * this.size) / this.largest));
  }

  /** Keeps labels readable: their size follows the distance to the viewer. */
  face(camera: Camera, height: number): void {
    for (const arrow of this.arrows) arrow.face(camera, height);
  }
}

class Arrow {
  readonly group = new Group();
  private readonly shaft: Mesh;
  private readonly head: Mesh;
  private readonly collar: Mesh;
  private readonly label = new Label();
  private readonly radius: number;

  constructor(size: number) {
    this.radius = 0.0085 * size;
    const paint = new MeshStandardMaterial({ color: COLOR, roughness: 0.55, envMapIntensity: 0.3 });
    const behind = new MeshBasicMaterial({ color: COLOR, transparent: true, opacity: 0.3, depthFunc: GreaterDepth, depthWrite: false });
    const pale = new MeshBasicMaterial({ color: COLOR, transparent: true, opacity: 0.35, depthWrite: false });
    this.shaft = new Mesh(new CylinderGeometry(1, 1, 1, 20).translate(0, -0.5, 0), paint);
    this.head = new Mesh(new ConeGeometry(1, 1, 24).translate(0, -0.5, 0), paint);
    this.collar = new Mesh(new CylinderGeometry(1, 1, 1, 20), pale);
    for (const part of [this.shaft, this.head]) {
      part.castShadow = true;
      part.add(new Mesh(part.geometry, behind)); // shows through the body
    }
    const point = new Mesh(new SphereGeometry(0.6 * this.radius, 16, 12), new MeshBasicMaterial({ color: 0xffffff }));
    this.group.add(this.shaft, this.head, this.collar, point, this.label.sprite);
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
    this.label.sprite.position.y = -length;
    this.label.write(newtons(contact.force_n, contact.std_n));
  }

  face(camera: Camera, height: number): void {
    this.label.scaleTo(camera, height);
  }
}

class Label {
  readonly sprite: Sprite;
  private readonly canvas = document.createElement("canvas");
  private readonly texture: CanvasTexture;
  private text = "";

  constructor() {
    this.canvas.width = 512;
    this.canvas.height = 96;
    this.texture = new CanvasTexture(this.canvas);
    this.texture.colorSpace = SRGBColorSpace;
    this.sprite = new Sprite(new SpriteMaterial({ map: this.texture, depthTest: false, transparent: true, toneMapped: false }));
    this.sprite.center.set(0.5, -0.25);
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
}
