// Forces over time: one line per tracked contact, with a band of ± one standard deviation.

import { pieces, timeText, type Frame } from "./data";

const COLORS = ["#ffb454", "#5fd3c6", "#c69bff", "#ff8a8a", "#9fd35f", "#6db3ff"];
const LEFT = 54;
const BOTTOM = 15;
const TOP = 8;

/** The colour of a contact over time. */
export function trackColor(track: number): string {
  return COLORS[Math.abs(track) % COLORS.length]!;
}

export class Plot {
  private readonly pen: CanvasRenderingContext2D;

  constructor(private readonly canvas: HTMLCanvasElement) {
    this.pen = canvas.getContext("2d")!;
  }

  /** Draws the frames between two times [s], and a mark at `now`. */
  draw(frames: Frame[], from: number, to: number, now: number): void {
    const ratio = Math.min(window.devicePixelRatio, 2);
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    if (this.canvas.width !== Math.round(width * ratio) || this.canvas.height !== Math.round(height * ratio)) {
      this.canvas.width = Math.round(width * ratio);
      this.canvas.height = Math.round(height * ratio);
    }
    const pen = this.pen;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const shown = frames.filter((f) => f.time_s >= from && f.time_s <= to);
    const top = niceTop(Math.max(...shown.flatMap((f) => f.contacts.map((c) => (c.force_n ?? 0) + (c.std_n ?? 0))), 0));
    const x = (t: number): number => LEFT + ((width - LEFT - 4) * (t - from)) / (to - from || 1);
    const y = (n: number): number => height - BOTTOM - ((height - BOTTOM - TOP) * n) / top;
    this.axes(from, to, top, x, y, width, height);
    const tracks = [...new Set(shown.flatMap((f) => f.contacts.map((c) => c.track)))];
    for (const track of tracks) this.track(shown, track, x, y);
    if (now >= from && now <= to) {
      pen.strokeStyle = "rgb(232 237 244 / 55%)";
      pen.beginPath();
      pen.moveTo(x(now), TOP);
      pen.lineTo(x(now), height - BOTTOM);
      pen.stroke();
    }
  }

  private axes(from: number, to: number, top: number, x: (t: number) => number, y: (n: number) => number, width: number, height: number): void {
    const pen = this.pen;
    pen.font = '10px system-ui, "Segoe UI", "DejaVu Sans", sans-serif';
    pen.fillStyle = "#9aa7b8";
    pen.strokeStyle = "rgb(160 185 220 / 16%)";
    pen.lineWidth = 1;
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    for (const n of [0, top / 2, top]) {
      pen.fillText(`${Number(n.toPrecision(2))} N`, LEFT - 5, y(n));
      pen.beginPath();
      pen.moveTo(LEFT, y(n));
      pen.lineTo(width - 4, y(n));
      pen.stroke();
    }
    pen.textBaseline = "bottom";
    pen.textAlign = "left";
    const minutes = Math.abs(to) >= 60;
    pen.fillText(timeText(from, 0, minutes), x(from), height);
    pen.textAlign = "right";
    pen.fillText(timeText(to, 0, minutes), x(to), height);
  }

  private track(frames: Frame[], track: number, x: (t: number) => number, y: (n: number) => number): void {
    const pen = this.pen;
    const color = trackColor(track);
    for (const run of runsOf(frames, track)) {
      pen.fillStyle = `${color}40`;
      pen.beginPath();
      run.forEach(({ t, n, std }, i) => (i ? pen.lineTo(x(t), y(n + std)) : pen.moveTo(x(t), y(n + std))));
      for (const { t, n, std } of [...run].reverse()) pen.lineTo(x(t), y(Math.max(0, n - std)));
      pen.fill();
      pen.strokeStyle = color;
      pen.lineWidth = 1.5;
      pen.beginPath();
      run.forEach(({ t, n }, i) => (i ? pen.lineTo(x(t), y(n)) : pen.moveTo(x(t), y(n))));
      if (run.length === 1) pen.arc(x(run[0]!.t), y(run[0]!.n), 1.5, 0, 7);
      pen.stroke();
    }
  }
}

/** Returns the time intervals in which a contact exists; an outage of the frames ends one. */
function runsOf(frames: Frame[], track: number): { t: number; n: number; std: number }[][] {
  const runs: { t: number; n: number; std: number }[][] = [];
  for (const piece of pieces(frames)) {
    let open = false;
    for (const frame of piece) {
      const contact = frame.contacts.find((c) => c.track === track);
      if (contact) {
        if (!open) runs.push([]);
        runs[runs.length - 1]!.push({ t: frame.time_s, n: contact.force_n ?? 0, std: contact.std_n ?? 0 });
      }
      open = contact !== undefined;
    }
  }
  return runs;
}

function niceTop(value: number): number {
  if (!(value > 0)) return 1;
  const ten = 10 ** Math.floor(Math.log10(value));
  return ([1, 2, 5].find((f) => f * ten >= value) ?? 10) * ten;
}
