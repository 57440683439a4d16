// The panel beside the robot and the curve above the time line.

import { newtons, totalForce, totalStd, type Frame } from "./data";

export function element<T extends Element = HTMLElement>(id: string): T {
  const found = document.getElementById(id);
  if (!found) throw new Error(`the page has no element ${id}`);
  return found as unknown as T;
}

export function showFrame(frame: Frame, largest: number): void {
  element("sum").textContent = frame.contacts.length ? newtons(totalForce(frame), totalStd(frame)) : "no contact";
  element("sum-label").textContent = frame.contacts.length > 1 ? `Sum of ${frame.contacts.length}` : "Contact force";
  element("contacts").replaceChildren(...frame.contacts.map((contact) => row(contact, largest)));
  const facts: [string, string][] = [];
  if (frame.frame !== null) facts.push(["Frame", String(frame.frame)]);
  if (frame.status) facts.push(["Status", frame.status]);
  if (frame.rms_after_m !== null) facts.push(["Residual, rms", `${(1e3 * frame.rms_after_m).toFixed(2)} mm`]);
  element("frame-facts").replaceChildren(...facts.flatMap(([name, value]) => [text("dt", name), text("dd", value)]));
}

/** Draws the sum of forces over time above the time line. */
export function drawCurve(frames: Frame[], duration: number): void {
  const total = frames.map(totalForce);
  const largest = Math.max(...total, 1e-12);
  const points = frames.map((f, i) => `${((1000 * f.time_s) / (duration || 1)).toFixed(2)},${(96 - (92 * total[i]!) / largest).toFixed(2)}`);
  const line = `M${points.join("L")}`;
  element("curve").innerHTML = `<path class="area" d="${line}L1000,100L0,100Z"/><path class="edge" d="${line}"/>`;
}

function row(contact: Frame["contacts"][number], largest: number): HTMLElement {
  const item = document.createElement("li");
  const source = text("span", contact.source);
  source.className = "source";
  const bar = document.createElement("div");
  bar.className = "bar";
  const share = (value: number): string => `${Math.min(100, (100 * Math.max(0, value)) / largest).toFixed(1)}%`;
  const upper = document.createElement("b");
  upper.style.width = share((contact.force_n ?? 0) + (contact.std_n ?? 0));
  const fill = document.createElement("i");
  fill.style.width = share(contact.force_n ?? 0);
  bar.append(upper, fill);
  const name = text("span", `Contact ${contact.contact} `);
  name.append(source);
  item.append(name, text("span", newtons(contact.force_n, contact.std_n)), bar);
  return item;
}

function text(tag: string, content: string): HTMLElement {
  const made = document.createElement(tag);
  made.textContent = content;
  return made;
}
