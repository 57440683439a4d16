// Directions and lengths in the image: the axes of the robot's frame, a scale bar, the size of the grid.

import { Quaternion, Vector3, type Camera, type Object3D } from "three";
import { niceLength } from "./body";
import { element } from "./readout";

const AXES = [
  ["x", 0xff7a70, new Vector3(1, 0, 0)],
  ["y", 0x7ee08a, new Vector3(0, 0, -1)],
  ["z", 0x7db8ff, new Vector3(0, 1, 0)],
] as const; // of the robot (Z up), in glTF's frame (Y up)
const LONG = 28; // length of an axis in the image [units of the svg]
const WIDEST = 120; // maximum width of the scale bar [px]
const NS = "http://www.w3.org/2000/svg";

export class Measures {
  private readonly lines: SVGLineElement[] = [];
  private readonly names: SVGTextElement[] = [];

  constructor() {
    const triad = element<SVGSVGElement>("triad");
    for (const [name, color] of AXES) {
      const paint = `#${color.toString(16)}`;
      const line = document.createElementNS(NS, "line");
      line.setAttribute("stroke", paint);
      const text = document.createElementNS(NS, "text");
      text.setAttribute("fill", paint);
      text.textContent = name;
      triad.append(line, text);
      this.lines.push(line);
      this.names.push(text);
    }
  }

  /** Shows the size of a cell of the ground [m]. */
  grid(cell: number): void {
    element("grid-size").textContent = `grid ${lengthText(cell)}`;
    element("measures").hidden = false;
  }

  /** Updates to the view: the robot's rotation in the room, and the pixels per metre at its position. */
  follow(camera: Camera, robot: Object3D, pixelsPerMetre: number): void {
    const turn = camera.getWorldQuaternion(new Quaternion()).invert().multiply(robot.getWorldQuaternion(new Quaternion()));
    AXES.forEach(([, , axis], i) => {
      const end = axis.clone().applyQuaternion(turn).multiplyScalar(LONG);
      this.lines[i]!.setAttribute("x2", end.x.toFixed(1));
      this.lines[i]!.setAttribute("y2", (-end.y).toFixed(1));
      this.lines[i]!.style.opacity = this.names[i]!.style.opacity = end.z < -0.3 * LONG ? "0.55" : "1"; // points away
      this.names[i]!.setAttribute("x", (1.28 * end.x).toFixed(1));
      this.names[i]!.setAttribute("y", (-1.28 * end.y + 4).toFixed(1));
    });
    const length = niceLength(WIDEST / pixelsPerMetre / 2.5);
    element("ruler").style.width = `${(length * pixelsPerMetre).toFixed(1)}px`;
    element("ruler-length").textContent = lengthText(length);
  }
}

/** A length in a readable unit: 5 mm, 2 cm, 1 m. */
function lengthText(metres: number): string {
  if (metres < 0.01) return `${Number((1000 * metres).toPrecision(2))} mm`;
  return metres < 1 ? `${Number((100 * metres).toPrecision(2))} cm` : `${Number(metres.toPrecision(2))} m`;
}
