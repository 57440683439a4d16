// The displayed data of one moment, from the files of a run or from a stream.

export type Vector = [number, number, number];

export interface Input {
  name: string;
  unit: string; // "N", "m", "Pa", or the unit of a sensor
  low: number;
  high: number;
}

export interface Contact {
  contact: number;
  track: number;
  point_m: Vector | null;
  force_vector_n: Vector | null;
  force_n: number | null;
  std_n: number | null;
  source: string;
  point_std_m: Vector | null;
  radius_m?: number | null;
  force_std_n: Vector | null;
}

/** A marker at rest, or a camera, in the robot frame [m]. */
export interface NamedPoint {
  name: string;
  position: Vector;
}

export interface Frame {
  time_s: number; // since the first frame, as in the animation; in a stream the source's clock
  frame: number | null; // number in the recording
  status: string | null;
  rms_after_m: number | null;
  run_s?: number | null; // since the beginning of a repeated run
  inputs: (number | null)[] | null;
  contacts: Contact[];
  forceless?: boolean; // no forces are estimated
}

export interface Run {
  name: string;
  inputs: Input[];
  frames: Frame[];
  markers: NamedPoint[];
  cameras: NamedPoint[];
  field?: { name: string; unit: string } | null; // in fields.bin: the largest value, then the ratio to it at each vertex of each frame
}

/** Returns the run, or null without one: the mesh is then shown alone. */
export async function loadRun(url: string): Promise<Run | null> {
  const answer = await fetch(url);
  if (answer.status === 404) return null;
  if (!answer.ok) throw new Error(`${url} could not be loaded (${answer.status}).`);
  const run = (await answer.json()) as Run & { format?: string };
  if (run.format !== "femsense-contacts-1") throw new Error(`${url} is not a list of contacts that this page knows.`);
  return { ...run, inputs: run.inputs ?? [], markers: run.markers ?? [], cameras: run.cameras ?? [] };
}

/** Returns the index of the frame nearest in time. */
export function frameAt(frames: { time_s: number }[], time: number): number {
  let low = 0;
  let high = frames.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (frames[middle]!.time_s <= time) low = middle;
    else high = middle;
  }
  return high >= 0 && Math.abs(frames[high]!.time_s - time) < Math.abs(frames[low]!.time_s - time) ? high : low;
}

const OUTAGE_S = 0.5;
const OUTAGE_STEPS = 4;

/** Splits frames at outages: steps longer than OUTAGE_S and OUTAGE_STEPS median steps. */
export function pieces<T extends { time_s: number }>(frames: T[]): T[][] {
  const steps = frames.slice(1).map((frame, i) => frame.time_s - frames[i]!.time_s);
  const median = [...steps].sort((a, b) => a - b)[steps.length >> 1] ?? 0;
  const longest = Math.max(OUTAGE_S, OUTAGE_STEPS * median);
  const found: T[][] = [];
  frames.forEach((frame, i) => (i && steps[i - 1]! <= longest ? found[found.length - 1]!.push(frame) : found.push([frame])));
  return found;
}

/** Whether the frame may be wrong, by its status. */
export function isDoubtful(frame: Frame): boolean {
  return Boolean(frame.status) && frame.status !== "ok";
}

export function totalForce(frame: Frame): number {
  return frame.contacts.reduce((sum, c) => sum + (c.force_n ?? 0), 0);
}

/** Standard deviation of a sum of independent forces. */
export function totalStd(frame: Frame): number | null {
  const known = frame.contacts.filter((c) => c.std_n !== null);
  return known.length ? Math.hypot(...known.map((c) => c.std_n!)) : null;
}

export function newtons(force: number | null, std: number | null): string {
  if (force === null) return "–";
  const digits = Math.abs(force) >= 10 ? 1 : 2;
  return std === null ? `${force.toFixed(digits)} N` : `${force.toFixed(digits)} ± ${std.toFixed(digits)} N`;
}

/** A value in a readable unit: kPa for pressures, mm for lengths. */
export function amount(value: number | null, unit: string): string {
  if (value === null || !Number.isFinite(value)) return "–";
  if (unit === "Pa") return `${(value / 1000).toFixed(1)} kPa`;
  if (unit === "m") return `${(1000 * value).toFixed(1)} mm`;
  return `${Math.abs(value) >= 100 ? value.toFixed(0) : value.toFixed(2)} ${unit}`.trim();
}

const DAY_S = 86400;

/** The time of a source: the time of day if it has such a clock, otherwise the time since its start, in seconds or with minutes. */
export function timeText(time: number, digits = 1, withMinutes = Math.abs(time) >= 60): string {
  if (Math.abs(time - Date.now() / 1000) < DAY_S) return new Date(1000 * time).toLocaleTimeString();
  if (!withMinutes) return `${time.toFixed(digits)} s`;
  const [minutes, seconds] = [Math.floor(time / 60), Math.floor(time % 60)];
  const two = (n: number): string => String(n).padStart(2, "0");
  return minutes < 60 ? `${minutes}:${two(seconds)}` : `${Math.floor(minutes / 60)}:${two(minutes % 60)}:${two(seconds)}`;
}

/** The time within a repeated run, otherwise that of the source. */
export function clockText(time: number, within: number | null, length: number | null): string {
  return within === null || length === null ? timeText(time) : `${Math.min(within, length).toFixed(1)} / ${length.toFixed(1)} s`;
}
