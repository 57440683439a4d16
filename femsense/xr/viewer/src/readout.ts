// The panel beside the robot: contacts, inputs, and properties of the frame.

import { amount, isDoubtful, newtons, pieces, totalForce, totalStd, type Contact, type Frame, type Input } from "./data";
import { trackColor } from "./plot";

export function element<T extends Element = HTMLElement>(id: string): T {
  const found = document.getElementById(id);
  if (!found) throw new Error(`the page has no element ${id}`);
  return found as unknown as T;
}

export function showFrame(frame: Frame, inputs: Input[], largest: number): void {
  element("panel").dataset.forceless = element("dock").dataset.forceless = String(frame.forceless === true);
  element("sum").textContent = frame.contacts.length ? newtons(totalForce(frame), totalStd(frame)) : "no contact";
  element("sum-label").textContent = frame.contacts.length > 1 ? `Sum of ${frame.contacts.length}` : "Contact force";
  fill(element("contacts"), frame.contacts, (contact, row) => showContact(contact, row, largest));
  const driven = frame.inputs ? inputs : [];
  element("inputs").hidden = driven.length === 0;
  fill(element("input-list"), driven, (input, row, i) => showInput(input, frame.inputs?.[i] ?? null, row));
  const facts: [string, string][] = [];
  if (frame.frame !== null) facts.push(["Frame", String(frame.frame)]);
  if (frame.status) facts.push(["Status", frame.status]);
  if (frame.rms_after_m !== null) facts.push(["Residual, rms", `${(1e3 * frame.rms_after_m).toFixed(2)} mm`]);
  element("panel").dataset.doubtful = String(isDoubtful(frame));
  fill(element("frame-facts"), facts, ([name, value], row) => {
    part(row, "dt").textContent = name;
    part(row, "dd").textContent = value;
  }, "div");
}

/** Draws the sum of forces over time above the time line, with a gap where frames are missing. */
export function drawCurve(frames: Frame[], from: number, to: number): void {
  const largest = Math.max(...frames.map(totalForce), 1e-12);
  const x = (f: Frame): string => ((1000 * (f.time_s - from)) / (to - from || 1)).toFixed(1);
  const paths = pieces(frames)
    .filter((piece) => piece.length > 1)
    .map((piece) => {
      const line = `M${piece.map((f) => `${x(f)},${(96 - (92 * totalForce(f)) / largest).toFixed(1)}`).join("L")}`;
      return `<path class="area" d="${line}L${x(piece[piece.length - 1]!)},100L${x(piece[0]!)},100Z"/><path class="edge" d="${line}"/>`;
    });
  element("curve").innerHTML = paths.join("");
}

function showContact(contact: Contact, row: HTMLElement, largest: number): void {
  const name = part(row, "span", "name");
  name.textContent = `Track ${contact.track}`; // the number of a contact in the terminal and in contacts.csv
  name.style.setProperty("--track", trackColor(contact.track)); // as in the plot
  part(row, "span", "value").textContent = newtons(contact.force_n, contact.std_n);
  const share = (value: number): string => `${Math.min(100, (100 * Math.max(0, value)) / largest).toFixed(1)}%`;
  const bar = part(row, "div", "bar");
  part(bar, "b").style.width = share((contact.force_n ?? 0) + (contact.std_n ?? 0));
  part(bar, "i").style.width = share((contact.force_n ?? 0) - (contact.std_n ?? 0));
  part(bar, "u").style.left = share(contact.force_n ?? 0);
  part(row, "span", "detail").textContent = place(contact);
}

/** The place of a contact and its uncertainty, in words. */
function place(contact: Contact): string {
  const said = [{ cloud: "seen", shape: "from the shape", given: "given" }[contact.source] ?? contact.source];
  if (contact.point_m) said.push(`at ${contact.point_m.map(millimetres).join(", ")}\u00a0mm`);
  if (contact.point_std_m) said.push(`± ${(1000 * Math.max(...contact.point_std_m)).toFixed(1)}\u00a0mm`);
  return said.filter(Boolean).join(" ");
}

function millimetres(metres: number): string {
  const whole = Math.round(1000 * metres);
  return whole < 0 ? `−${-whole}` : String(Math.abs(whole));
}

function showInput(input: Input, value: number | null, row: HTMLElement): void {
  part(row, "span", "name").textContent = input.name;
  part(row, "span", "value").textContent = amount(value, input.unit);
  const bar = part(row, "div", "bar");
  const span = input.high - input.low || 1;
  const share = Math.max(0, Math.min(1, ((value ?? input.low) - input.low) / span));
  bar.setAttribute("role", "meter");
  bar.setAttribute("aria-label", input.name);
  bar.setAttribute("aria-valuemin", String(input.low));
  bar.setAttribute("aria-valuemax", String(input.high));
  bar.setAttribute("aria-valuenow", String(value ?? input.low));
  bar.setAttribute("aria-valuetext", amount(value, input.unit));
  bar.dataset.kind = input.unit;
  part(bar, "i").style.width = `${(100 * share).toFixed(1)}%`;
}

/** Creates one row per item and fills it; existing rows are reused to avoid flicker. */
function fill<T>(list: Element, items: T[], show: (item: T, row: HTMLElement, index: number) => void, tag = "li"): void {
  while (list.children.length > items.length) list.lastElementChild!.remove();
  while (list.children.length < items.length) list.append(document.createElement(tag));
  items.forEach((item, i) => show(item, list.children[i] as HTMLElement, i));
}

/** Returns the child of a kind, created if it is missing. */
function part(parent: Element, tag: string, name = ""): HTMLElement {
  const found = parent.querySelector<HTMLElement>(`:scope > ${tag}${name ? `.${name}` : ""}`);
  if (found) return found;
  const made = document.createElement(tag);
  if (name) made.className = name;
  parent.append(made);
  return made;
}
