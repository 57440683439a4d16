// The bytes of a stream (docs/guides/streaming.md): frames of messages, poses, clouds, documents.

import type { Contact, Frame, Input, NamedPoint, Vector } from "./data";
import type { Field } from "./paint";

export interface Message {
  robot: string;
  kind: string;
  payload: Uint8Array;
}

export interface Model {
  name: string;
  inRobotFrame: boolean; // otherwise the frame of the markers of the training data
  glb: string;
  digest: string;
  bones: string[];
  inputs: Input[];
  handles: NamedPoint[];
  markers: NamedPoint[];
  cameras: NamedPoint[];
  commands: boolean;
  error: number | null; // of a learnt model, root mean square distance of its markers from measured ones [m]
  duration: number | null; // duration of a repeated run [s]
  field: { name: string; unit: string } | null; // the field that colours the body
}

export interface Pose {
  seq: number;
  time: number;
  bones: Float32Array; // x y z qx qy qz qw of each, robot frame
}

export interface Status {
  state: string;
  detail: string;
  since_s: number | null; // when the last pose was sent, by the sender's clock [s since 1970]
}

export interface Reach {
  status: string;
  text: string;
  error_m: number;
  ms: number;
  armed: boolean;
  inputs: { name: string; value: number; unit: string }[];
}

/** The holder of the lease. */
export interface Lease {
  client: string; // "": nobody
  number: number;
  stopped: boolean; // by a stop of any client, which disarms all
}

const text = new TextDecoder();
const bytes = new TextEncoder();

export function unpack(frame: ArrayBuffer): Message[] {
  const view = new DataView(frame);
  const found: Message[] = [];
  for (let at = 0; at + 6 <= frame.byteLength; ) {
    const name = view.getUint16(at, true);
    const size = view.getUint32(at + 2, true);
    const body = at + 6 + name;
    if (body + size > frame.byteLength) break;
    const [prefix, robot, kind] = text.decode(new Uint8Array(frame, at + 6, name)).split("/");
    if (prefix === "femsense" && robot && kind) found.push({ robot, kind, payload: new Uint8Array(frame, body, size) });
    at = body + size;
  }
  return found;
}

export function pack(robot: string, kind: string, document: object): Uint8Array<ArrayBuffer> {
  const topic = bytes.encode(`femsense/${robot}/${kind}`);
  const payload = bytes.encode(JSON.stringify(document));
  const frame = new Uint8Array(6 + topic.length + payload.length);
  const view = new DataView(frame.buffer);
  view.setUint16(0, topic.length, true);
  view.setUint32(2, payload.length, true);
  frame.set(topic, 6);
  frame.set(payload, 6 + topic.length);
  return frame;
}

export function readPose(payload: Uint8Array): Pose | null {
  const view = new DataView(payload.buffer, payload.byteOffset, payload.byteLength);
  if (payload.byteLength < 20 || text.decode(payload.subarray(0, 4)) !== "FSP1") return null;
  const count = view.getUint16(16, true);
  if (payload.byteLength !== 20 + 28 * count) return null;
  return { seq: view.getUint32(4, true), time: view.getFloat64(8, true), bones: floats(payload, 20, 7 * count) };
}

/** Returns x y z residual of each point [m]. */
export function readCloud(payload: Uint8Array): Float32Array | null {
  const view = new DataView(payload.buffer, payload.byteOffset, payload.byteLength);
  if (payload.byteLength < 20 || text.decode(payload.subarray(0, 4)) !== "FSC1") return null;
  const count = view.getUint32(16, true);
  return payload.byteLength === 20 + 16 * count ? floats(payload, 20, 4 * count) : null;
}

/** Returns the largest value, and the ratio to it at each vertex, 0 … 255. */
export function readField(payload: Uint8Array): Pick<Field, "largest" | "values"> | null {
  const view = new DataView(payload.buffer, payload.byteOffset, payload.byteLength);
  if (payload.byteLength < 24 || text.decode(payload.subarray(0, 4)) !== "FSV1") return null;
  return payload.byteLength === 24 + view.getUint32(16, true) ? { largest: view.getFloat32(20, true), values: payload.slice(24) } : null;
}

export function readModel(payload: Uint8Array): Model | null {
  const told = document(payload);
  if (!told || told.schema !== "femsense-model-1") return null;
  return {
    name: String(told.name ?? "robot"),
    inRobotFrame: !String(told.frame ?? "robot").startsWith("markers"),
    glb: String(told.glb ?? ""),
    digest: String(told.glb_sha256 ?? ""),
    bones: list(told.bones).map((b) => String(b.name)),
    inputs: list(told.inputs).map((i) => ({ name: String(i.name), unit: String(i.unit ?? ""), low: number(i.low) ?? 0, high: number(i.high) ?? 0 })),
    handles: list(told.handles).map(named),
    markers: list(told.markers).map(named),
    cameras: list(told.cameras).map(named),
    commands: told.commands === true,
    duration: number(told.duration_s),
    error: number(told.error_m),
    field: told.field ? quantity(told.field as Record<string, unknown>) : null,
  };
}

export function readForces(payload: Uint8Array): Pick<Frame, "frame" | "status" | "rms_after_m" | "run_s" | "contacts" | "forceless"> | null {
  const told = document(payload);
  if (!told) return null;
  const frame = number(told.frame);
  return {
    frame: frame === null || frame < 0 ? null : frame,
    status: typeof told.status === "string" ? told.status : null,
    rms_after_m: number(told.residual_m),
    run_s: number(told.run_s),
    contacts: list(told.contacts).map(contact),
    forceless: told.contacts === undefined,
  };
}

export function readInputs(payload: Uint8Array): (number | null)[] | null {
  const told = document(payload);
  return told ? list(told.inputs).map((i) => number(i.value)) : null;
}

export function readStatus(payload: Uint8Array): Status | null {
  const told = document(payload);
  return told ? { state: String(told.state ?? ""), detail: String(told.detail ?? ""), since_s: number(told.since_s) } : null;
}

export function readReach(payload: Uint8Array): Reach | null {
  const told = document(payload);
  if (!told) return null;
  return {
    status: String(told.status ?? ""),
    text: String(told.text ?? ""),
    error_m: number(told.error_m) ?? NaN,
    ms: number(told.ms) ?? NaN,
    armed: told.armed === true,
    inputs: list(told.inputs).map((i) => ({ name: String(i.name), value: number(i.value) ?? NaN, unit: String(i.unit ?? "") })),
  };
}

export function readLease(payload: Uint8Array): Lease | null {
  const told = document(payload);
  return told ? { client: String(told.client ?? ""), number: number(told.number) ?? 0, stopped: told.stopped === true } : null;
}

function quantity(told: Record<string, unknown>): { name: string; unit: string } {
  return { name: String(told.name ?? ""), unit: String(told.unit ?? "") };
}

function named(told: Record<string, unknown>): NamedPoint {
  return { name: String(told.name), position: vector(told.position_m) ?? [0, 0, 0] };
}

function contact(told: Record<string, unknown>): Contact {
  return {
    contact: number(told.contact) ?? 0,
    track: number(told.track) ?? 0,
    point_m: vector(told.point_m),
    force_vector_n: vector(told.force_n),
    force_n: number(told.size_n),
    std_n: number(told.std_n),
    source: String(told.source ?? ""),
    point_std_m: vector(told.point_std_m),
    radius_m: number(told.radius_m),
    force_std_n: vector(told.force_std_n),
  };
}

function document(payload: Uint8Array): Record<string, unknown> | null {
  try {
    const value: unknown = JSON.parse(text.decode(payload));
    return value !== null && typeof value === "object" && !Array.isArray(value) ? (value as Record<string, unknown>) : null;
  } catch {
    return null;
  }
}

function list(value: unknown): Record<string, unknown>[] {
  return Array.isArray(value) ? value.filter((v): v is Record<string, unknown> => v !== null && typeof v === "object") : [];
}

function number(value: unknown): number | null {
  return typeof value === "number" && Number.isFinite(value) ? value : null;
}

function vector(value: unknown): Vector | null {
  if (value === null || typeof value !== "object") return null;
  const { x, y, z } = value as Record<string, unknown>;
  const [a, b, c] = [number(x), number(y), number(z)];
  return a === null || b === null || c === null ? null : [a, b, c];
}

/** A copy, since floats must be aligned to four bytes. */
function floats(payload: Uint8Array, at: number, count: number): Float32Array {
  return new Float32Array(payload.slice(at, at + 4 * count).buffer);
}
