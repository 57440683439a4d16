// Alignment of the twin with the real robot: the user touches its markers, and cameras with a calibrated pose, one after another.

import { Matrix4, Mesh, MeshBasicMaterial, Quaternion, SphereGeometry, Vector3, type Object3D } from "three";

const FEWEST = 3;
const FLAT = 0.02; // minimum ratio of the spread across the principal line to that along it: otherwise the rotation about the line is undetermined

export interface Landmark {
  name: string;
  place: () => Vector3; // current position, in the frame of the robot's group
}

export class Alignment {
  /** Root mean square residual of the fit [m]. */
  rms = NaN;
  private readonly touched: Vector3[] = [];
  private readonly meant: Vector3[] = [];
  private readonly mark = new Mesh(new SphereGeometry(1, 20, 14), new MeshBasicMaterial({ color: 0xff5ad0, transparent: true, opacity: 0.85, depthTest: false }));
  private done = false;

  constructor(
    private readonly landmarks: Landmark[],
    robot: Object3D,
    size: number,
    private readonly say: (text: string) => void,
  ) {
    this.mark.scale.setScalar(0.02 * size);
    this.mark.renderOrder = 8;
    robot.add(this.mark);
    this.ask();
  }

  /** Whether further points must be touched. */
  get open(): boolean {
    return !this.done;
  }

  /** Assigns a position in the room to the next point; returns the pose of the robot after the last one. */
  take(place: Vector3): Matrix4 | null {
    this.meant.push(this.landmarks[this.touched.length]!.place());
    this.touched.push(place.clone());
    if (this.touched.length < this.landmarks.length) {
      this.ask();
      return null;
    }
    const pose = rigidFit(this.meant, this.touched);
    if (!pose) {
      this.touched.length = this.meant.length = 0;
      this.ask("these points lie on a line: again, ");
      return null;
    }
    const left = this.meant.map((p, i) => p.clone().applyMatrix4(pose).distanceTo(this.touched[i]!));
    this.rms = Math.sqrt(left.reduce((sum, d) => sum + d * d, 0) / left.length);
    this.end(`aligned: ${(1000 * this.rms).toFixed(1)} mm at ${left.length} points`);
    return pose;
  }

  /** Moves the marker ring to the requested point. */
  step(): void {
    const next = this.landmarks[this.touched.length];
    this.mark.visible = this.open && next !== undefined;
    if (next) this.mark.position.copy(next.place());
  }

  end(text = ""): void {
    this.done = true;
    this.mark.removeFromParent();
    this.say(text);
  }

  private ask(before = ""): void {
    this.say(`${before}touch ${this.landmarks[this.touched.length]!.name} of the real robot (${this.touched.length + 1} of ${this.landmarks.length})`);
  }
}

/** Whether these points determine an alignment. */
export function enough(landmarks: Landmark[]): boolean {
  return landmarks.length >= FEWEST;
}

/** Returns the rigid transform between two point sets with the smallest sum of squares, or null if the points do not determine it.
 *
 * Horn (1987), Closed-form solution of absolute orientation using unit quaternions: the eigenvector of the largest eigenvalue. */
export function rigidFit(from: Vector3[], to: Vector3[]): Matrix4 | null {
  if (from.length < FEWEST || from.length !== to.length) return null;
  const [a, b] = [middle(from), middle(to)];
  const s = (i: number, j: number): number =>
    from.reduce((sum, p, k) => sum + (p.getComponent(i) - a.getComponent(i)) * (to[k]!.getComponent(j) - b.getComponent(j)), 0);
  const [xx, xy, xz, yx, yy, yz, zx, zy, zz] = [s(0, 0), s(0, 1), s(0, 2), s(1, 0), s(1, 1), s(1, 2), s(2, 0), s(2, 1), s(2, 2)];
  const N = [
    [xx + yy + zz, yz - zy, zx - xz, xy - yx],
    [yz - zy, xx - yy - zz, xy + yx, zx + xz],
    [zx - xz, xy + yx, yy - xx - zz, yz + zy],
    [xy - yx, zx + xz, yz + zy, zz - xx - yy],
  ];
  const { values, vectors } = eigen(N);
  const order = [0, 1, 2, 3].sort((i, j) => values[j]! - values[i]!);
  const [best, second] = [order[0]!, order[1]!];
  if (!(values[best]! - values[second]! > FLAT ** 2 * values[best]!)) return null;
  const [w, x, y, z] = [0, 1, 2, 3].map((i) => vectors[i]![best]!) as [number, number, number, number];
  const turn = new Quaternion(x, y, z, w).normalize();
  return new Matrix4().compose(b.sub(a.applyQuaternion(turn)), turn, new Vector3(1, 1, 1));
}

function middle(points: Vector3[]): Vector3 {
  return points.reduce((sum, p) => sum.add(p), new Vector3()).divideScalar(points.length);
}

/** Eigenvalues and eigenvectors (columns) of a small symmetric matrix by Jacobi's rotations. */
function eigen(symmetric: number[][]): { values: number[]; vectors: number[][] } {
  const n = symmetric.length;
  const A = symmetric.map((row) => [...row]);
  const V = A.map((_, i) => A.map((__, j) => Number(i === j)));
  for (let round = 0; round < 30; round++) {
    for (let p = 0; p < n; p++) for (let q = p + 1; q < n; q++) rotate(A, V, p, q);
  }
  return { values: A.map((row, i) => row[i]!), vectors: V };
}

function rotate(A: number[][], V: number[][], p: number, q: number): void {
  if (Math.abs(A[p]![q]!) < 1e-300) return;
  const angle = 0.5 * Math.atan2(2 * A[p]![q]!, A[q]![q]! - A[p]![p]!);
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  for (const M of [A, V]) for (const row of M) [row[p], row[q]] = [c * row[p]! - s * row[q]!, s * row[p]! + c * row[q]!];
  for (let k = 0; k < A.length; k++) [A[p]![k], A[q]![k]] = [c * A[p]![k]! - s * A[q]![k]!, s * A[p]![k]! + c * A[q]![k]!];
}
