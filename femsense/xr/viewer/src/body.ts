// One robot in the scene: its skinned mesh, the rest state, measurements, and contact forces.

import {
  AxesHelper,
  Bone,
  Box3,
  BufferAttribute,
  BufferGeometry,
  Color,
  Group,
  Mesh,
  MeshBasicMaterial,
  MeshStandardMaterial,
  Points,
  PointsMaterial,
  SkinnedMesh,
  Vector3,
  type Box2,
  type Camera,
  type Object3D,
} from "three";
import { GLTFLoader, type GLTF } from "three/addons/loaders/GLTFLoader.js";
import { ForceArrows } from "./arrows";
import type { Contact, NamedPoint } from "./data";
import { Painter, type Paint } from "./paint";
import { tie } from "./ties";

const SAMPLED = 600; // number of vertices for the approximate bounding box
const GREY = 0x6b7177; // colour of stale data
const AMBER = 0xf08c00; // colour of unreliable data
const FAR = 4; // residuals beyond this multiple of the scale belong to the surroundings

export async function loadMesh(url: string): Promise<GLTF> {
  const answer = await fetch(url);
  if (!answer.ok) throw new Error(`${url} could not be loaded (${answer.status}).\nIs the run complete? femsense export RUN -o robot.glb writes it.`);
  return await new GLTFLoader().parseAsync(await answer.arrayBuffer(), "");
}

export class Body {
  /** All of the robot, in glTF's frame (Y up). */
  readonly group = new Group();
  /** For objects in the robot frame (Z up). */
  readonly robotFrame = new Group();
  readonly skins: SkinnedMesh[];
  readonly bones: Bone[];
  readonly size: number;
  readonly arrows: ForceArrows;
  readonly painter: Painter;
  /** Residual with full saturation [m]. */
  readonly residualScale: number;
  private readonly ghost = new Group();
  private readonly cloud = new Points(new BufferGeometry(), cloudMaterial());
  private readonly base: AxesHelper;
  private readonly joints = dots(0xffffff, 7);
  private readonly marks = dots(0xff5ad0, 10);
  private markers: (() => Vector3)[] = [];
  private stale = false;
  private doubtful = false;
  private cloudSeen = false;

  constructor(readonly gltf: GLTF) {
    gltf.scene.getObjectByName("forces")?.removeFromParent(); // arrows for viewers without their own
    this.skins = skinned(gltf.scene);
    this.bones = this.skins.flatMap((skin) => skin.skeleton.bones);
    const rest = new Box3().setFromObject(gltf.scene);
    this.size = rest.getSize(new Vector3()).length() || 1;
    this.residualScale = niceLength(0.004 * this.size);
    this.arrows = new ForceArrows(this.size);
    this.painter = new Painter(this.size);
    this.robotFrame.rotation.x = -Math.PI / 2;
    this.base = new AxesHelper(0.2 * this.size).setColors(new Color(0xff7a70), new Color(0x7ee08a), new Color(0x7db8ff));
    Object.assign(this.base.material, { depthTest: false, transparent: true });
    this.robotFrame.add(this.arrows.group, this.cloud, this.base, this.joints);
    this.showParts(false);
    this.cloud.frustumCulled = false;
    this.ghost.visible = false;
    this.group.add(gltf.scene, this.robotFrame, this.ghost, this.marks);
    for (const skin of this.skins) this.prepare(skin);
  }

  /** Places the bones: x y z qx qy qz qw of each, robot frame. */
  pose(rows: Float32Array): void {
    poseBones(this.bones, rows);
  }

  /** Sets the markers that are shown with the bones. */
  setMarkers(markers: NamedPoint[]): void {
    this.markers = markers.map((marker) => tie(this, marker.position));
  }

  /** Shows base, bones and markers, also through the body. */
  showParts(visible: boolean): void {
    this.base.visible = this.joints.visible = this.marks.visible = visible;
  }

  /** Updates view-dependent objects, before each image. */
  face(camera: Camera, height: number, room: Box2 | null): void {
    this.arrows.face(camera, height, room);
    if (!this.base.visible) return;
    this.joints.geometry.setFromPoints(this.bones.map((bone) => bone.position));
    this.marks.geometry.setFromPoints(this.markers.map((place) => place()));
  }

  /** Returns the bounding box of the body, in glTF's frame. */
  space(): Box3 {
    const box = new Box3();
    this.gltf.scene.updateMatrixWorld(true);
    for (const skin of this.skins) {
      skin.computeBoundingBox();
      if (skin.boundingBox) box.union(skin.boundingBox);
    }
    return box;
  }

  /** Returns an approximate bounding box of body and arrows, in glTF's frame; fast enough for repeated calls. */
  extent(contacts: Contact[]): Box3 {
    const box = new Box3().setFromPoints(this.arrows.group.visible ? this.arrows.ends(contacts) : []);
    this.gltf.scene.updateMatrixWorld(true);
    const place = new Vector3();
    for (const skin of this.skins) {
      const count = skin.geometry.getAttribute("position")?.count ?? 0;
      const every = Math.max(1, Math.ceil(count / SAMPLED));
      for (let i = 0; i < count; i += every) box.expandByPoint(skin.getVertexPosition(i, place));
    }
    return box;
  }

  show(contacts: Contact[]): void {
    this.arrows.show(contacts);
    this.painter.contacts(contacts);
  }

  /** Shows the body in grey: its data are stale. */
  setStale(stale: boolean): void {
    if (stale === this.stale) return;
    this.stale = stale;
    this.fade();
  }

  /** Colours the whole body: its data may be wrong. */
  setDoubtful(doubtful: boolean): void {
    if (doubtful === this.doubtful) return;
    this.doubtful = doubtful;
    this.fade();
  }

  get isDoubtful(): boolean {
    return this.doubtful;
  }

  private fade(): void {
    this.arrows.tell(this.stale ? "stale" : this.doubtful ? "doubtful" : "");
    this.painter.fade(this.stale ? 0.9 : this.doubtful ? 0.93 : 0, this.stale ? GREY : AMBER);
  }

  get isStale(): boolean {
    return this.stale;
  }

  showGhost(visible: boolean): void {
    this.ghost.visible = visible;
  }

  /** Colours the body. */
  paint(paint: Paint): void {
    this.painter.show(paint, this.motionScale);
  }

  /** Displacement with full saturation [m]. */
  get motionScale(): number {
    return 0.15 * this.size;
  }

  showCloud(visible: boolean): void {
    this.cloud.visible = visible;
  }

  get hasCloud(): boolean {
    return this.cloudSeen;
  }

  /** Shows measured points, coloured by their distance from the surface: blue inside, red outside, grey if they belong to another object. */
  setCloud(rows: Float32Array): void {
    const count = rows.length / 4;
    this.cloudSeen ||= count > 0;
    const places = new Float32Array(3 * count);
    const colors = new Float32Array(3 * count);
    const color = new Color();
    for (let i = 0; i < count; i++) {
      places.set(rows.subarray(4 * i, 4 * i + 3), 3 * i);
      residualColor(rows[4 * i + 3]! / this.residualScale, color);
      color.toArray(colors, 3 * i);
    }
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(places, 3));
    geometry.setAttribute("color", new BufferAttribute(colors, 3));
    this.cloud.geometry.dispose();
    this.cloud.geometry = geometry;
  }

  private prepare(skin: SkinnedMesh): void {
    const material = (skin.material as MeshStandardMaterial).clone();
    skin.material = material;
    this.painter.prepare(material, skin);
    const pale = new MeshBasicMaterial({ color: 0xb8c7db, transparent: true, opacity: 0.16, depthWrite: false });
    this.ghost.add(new Mesh(skin.geometry, pale));
  }
}

/** Small points, visible through the body. */
function dots(color: number, size: number): Points {
  const points = new Points(new BufferGeometry(), new PointsMaterial({ color, size, sizeAttenuation: false, depthTest: false, transparent: true }));
  points.frustumCulled = false;
  points.renderOrder = 4;
  return points;
}

/** Points of a measured cloud, drawn slightly closer to the viewer, since half of them lie behind the measured surface. */
function cloudMaterial(): PointsMaterial {
  const material = new PointsMaterial({ size: 4, sizeAttenuation: false, vertexColors: true });
  material.onBeforeCompile = (shader) => {
    shader.vertexShader = shader.vertexShader.replace("#include <project_vertex>", "#include <project_vertex>\n\tgl_Position = projectionMatrix * vec4(mvPosition.xyz * 0.98, mvPosition.w);");
  };
  return material;
}

/** Places bones by rows x y z qx qy qz qw in the robot frame, which is that of their parent. */
export function poseBones(bones: Bone[], rows: Float32Array): void {
  const count = Math.min(bones.length, rows.length / 7);
  for (let b = 0; b < count; b++) {
    bones[b]!.position.fromArray(rows, 7 * b);
    bones[b]!.quaternion.fromArray(rows, 7 * b + 3);
  }
}

/** Blue for points inside the surface, white on it, red outside; grey far away. */
export function residualColor(share: number, into: Color): Color {
  if (!Number.isFinite(share) || Math.abs(share) > FAR) return into.setRGB(0.32, 0.35, 0.4);
  const s = Math.max(-1, Math.min(1, share));
  return s > 0 ? into.setRGB(1, 1 - 0.75 * s, 1 - 0.85 * s) : into.setRGB(1 + 0.8 * s, 1 + 0.5 * s, 1);
}

/** 1, 2 or 5 times a power of ten. */
export function niceLength(length: number): number {
  const ten = 10 ** Math.floor(Math.log10(length));
  return ([1, 2, 5].find((f) => f * ten >= length) ?? 10) * ten;
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
