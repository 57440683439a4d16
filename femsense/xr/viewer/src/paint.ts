// Colouring of the body: none, displacement from rest, stress, or the probability density of a contact at each point.

import { BufferAttribute, Color, Vector4, type MeshStandardMaterial, type SkinnedMesh } from "three";
import type { Contact } from "./data";

export const PAINTS = ["none", "motion", "stress", "contact"] as const;
export type Paint = (typeof PAINTS)[number];

const CONTACTS = 8; // maximum number of displayed contacts
const FINEST = 0.004; // minimum displayed width of a contact, relative to the body's size

/** A field at each vertex and frame, 0 … 255 for 0 … largest. */
export interface Field {
  name: string;
  unit: string;
  largest: number;
  values: Uint8Array; // ordered by frame
}

export class Painter {
  private readonly mode = { value: 0 };
  private readonly scale = { value: 1 };
  private readonly faded = { value: 0 };
  private readonly fadedTo = { value: new Color() };
  private readonly places = { value: Array.from({ length: CONTACTS }, () => new Vector4(0, 0, 0, 0)) };
  private readonly attributes: BufferAttribute[] = [];
  private field: Field | null = null;
  private paint: Paint = "none";

  /** size: of the body [m]. */
  constructor(private readonly size: number) {}

  /** Connects a material to this colouring. */
  prepare(material: MeshStandardMaterial, skin: SkinnedMesh): void {
    const attribute = new BufferAttribute(new Uint8Array(skin.geometry.getAttribute("position")!.count), 1, true);
    skin.geometry.setAttribute("paintField", attribute);
    this.attributes.push(attribute);
    material.onBeforeCompile = (shader) => {
      Object.assign(shader.uniforms, { paintMode: this.mode, paintScale: this.scale, paintPlaces: this.places, paintFaded: this.faded, paintFadedTo: this.fadedTo });
      shader.vertexShader = shader.vertexShader
        .replace("#include <common>", "#include <common>\nattribute float paintField;\nvarying float vField;\nvarying float vMotion;\nvarying vec3 vPlace;")
        .replace("#include <skinning_vertex>", "#include <skinning_vertex>\nvMotion = length(transformed - position);\nvField = paintField;\nvPlace = transformed;");
      shader.fragmentShader = shader.fragmentShader
        .replace(
          "#include <common>",
          `#include <common>
          varying float vField; varying float vMotion; varying vec3 vPlace;
          uniform int paintMode; uniform float paintScale; uniform float paintFaded; uniform vec3 paintFadedTo; uniform vec4 paintPlaces[${CONTACTS}];`,
        )
        .replace("#include <color_fragment>", `#include <color_fragment>\n${COLORING}`);
    };
  }

  /** largest: displacement with full saturation [m]. */
  show(paint: Paint, largest: number): void {
    this.paint = paint;
    this.choose();
    this.scale.value = Math.max(largest, 1e-9);
  }

  /** Blends all colours with another one. */
  fade(share: number, to: number): void {
    this.faded.value = share;
    this.fadedTo.value.set(to);
  }

  setField(field: Field | null): void {
    this.field = field;
    this.choose();
  }

  /** Shows the field of a frame. */
  frame(index: number): void {
    if (!this.field) return;
    const vertices = this.attributes.reduce((sum, a) => sum + a.count, 0);
    if (this.field.values.length < (index + 1) * vertices) return; // of another mesh
    let at = index * vertices;
    for (const attribute of this.attributes) {
      attribute.array.set(this.field.values.subarray(at, at + attribute.count));
      attribute.needsUpdate = true;
      at += attribute.count;
    }
  }

  private choose(): void {
    this.mode.value = this.paint === "stress" && !this.field ? 0 : PAINTS.indexOf(this.paint);
  }

  /** The density of a contact at a point, from the standard deviation of its place and the size of its patch. */
  contacts(contacts: Contact[]): void {
    this.places.value.forEach((place, i) => {
      const contact = contacts[i];
      if (!contact?.point_m) return place.set(0, 0, 0, 0);
      const [x, y, z] = contact.point_m; // robot frame → glTF's
      return place.set(x, z, -y, Math.hypot(Math.max(...(contact.point_std_m ?? [0])), contact.radius_m ?? 0, FINEST * this.size));
    });
  }
}

const COLORING = `
if (paintMode > 0) {
  float s = paintMode == 1 ? vMotion / paintScale : vField;
  if (paintMode == 3) {
    s = 0.0;
    for (int i = 0; i < ${CONTACTS}; i++) {
      vec3 off = vPlace - paintPlaces[i].xyz;
      if (paintPlaces[i].w > 0.0) s = max(s, exp(-0.5 * dot(off, off) / (paintPlaces[i].w * paintPlaces[i].w)));
    }
  }
  s = clamp(s, 0.0, 1.0);
  vec3 low = vec3(0.03, 0.02, 0.20), middle = vec3(0.10, 0.42, 0.42), high = vec3(0.95, 0.80, 0.10);
  diffuseColor.rgb = s < 0.5 ? mix(low, middle, 2.0 * s) : mix(middle, high, 2.0 * s - 1.0);
}
diffuseColor.rgb = mix(diffuseColor.rgb, paintFadedTo, paintFaded);`;
