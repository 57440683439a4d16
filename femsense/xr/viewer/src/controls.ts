// Buttons and keys shared by recorded runs and streams.

import { Alignment, enough, type Landmark } from "./alignment";
import type { Body } from "./body";
import { PAINTS, type Paint } from "./paint";
import { element } from "./readout";
import type { Stage } from "./stage";

/** Creates a toggle button; returns the handler of its key. */
export function toggle(id: string, change: (on: boolean) => void): () => void {
  const button = element<HTMLButtonElement>(id);
  const act = (): void => {
    if (button.hidden || button.disabled) return;
    const on = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", String(on));
    change(on);
  };
  button.addEventListener("click", act);
  return act;
}

/** Connects the selection of the colouring; returns the handler of its key. */
export function paintChoice(change: (paint: Paint) => void): () => void {
  const choice = element<HTMLSelectElement>("paint");
  const act = (): void => change(choice.value as Paint);
  choice.addEventListener("change", act);
  return () => {
    const open = PAINTS.filter((paint) => !choice.querySelector<HTMLOptionElement>(`[value=${paint}]`)?.hidden);
    choice.value = open[(open.indexOf(choice.value as Paint) + 1) % open.length]!;
    act();
  };
}

/** Shows the legend of the colours below the figures of the panel. */
export function paintLegend(paint: Paint, body: Body | null, stress = ""): void {
  const said = { none: "", motion: body ? `${(1000 * body.motionScale).toPrecision(2)} mm of motion` : "", stress, contact: "contact likely" }[paint];
  element("scale").hidden = !said;
  element("scale-top").textContent = said;
}

/** In AR, and with `Align`, aligns the twin with the real robot: the user touches its markers and cameras one after another. */
export function alignWith(stage: Stage, body: Body, landmarks: Landmark[]): Alignment | null {
  const wanted = element("align").getAttribute("aria-pressed") === "true" && document.documentElement.dataset.xr === "immersive-ar";
  if (!wanted || !enough(landmarks)) return null;
  return new Alignment(landmarks, stage.robot, body.size, (text) => {
    stage.headset.say(text);
    element("badge").title = text;
  });
}

/** Connects the buttons of the view, and keys. */
export function connectTools(stage: Stage, keys: Record<string, () => void>): void {
  const grid = toggle("grid", (on) => stage.showGround(on));
  element("reset").addEventListener("click", () => stage.lookFromStart());
  const all: Record<string, () => void> = { g: grid, r: () => stage.lookFromStart(), ...keys };
  window.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const onButton = event.target instanceof HTMLButtonElement && (event.key === " " || event.key === "Enter");
    const act = all[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!act || onButton) return;
    event.preventDefault();
    act();
  });
}

/** Shows the buttons for headset sessions, if supported. */
export function offerHeadset(stage: Stage): void {
  for (const [id, mode] of [
    ["enter-vr", "immersive-vr"],
    ["enter-ar", "immersive-ar"],
  ] as const) {
    const button = element<HTMLButtonElement>(id);
    navigator.xr?.isSessionSupported(mode).then(
      (yes) => {
        button.hidden = !yes;
        if (mode === "immersive-ar") element("align").hidden = !yes;
      },
      () => (button.hidden = true),
    );
    button.addEventListener("click", () => stage.headset.toggle(mode).catch((e: Error) => notice(`The headset did not open: ${e.message}`)));
  }
  toggle("align", () => undefined);
  for (const id of ["panel", "dock", "dragging", "top"]) element(id).addEventListener("beforexrselect", (event) => event.preventDefault());
}

/** Passes the heights of the title, the buttons next to it and the bar to the styles of the elements between them. */
export function announceEdges(): void {
  for (const id of ["top", "actions", "dock"]) {
    const edge = element(id);
    new ResizeObserver(() => document.documentElement.style.setProperty(`--${id}`, `${edge.offsetHeight}px`)).observe(edge);
  }
}

/** Indicates that the panel continues below its visible part. */
export function announceMore(): void {
  const [panel, more] = [element("panel"), element("more")];
  const look = (): void => {
    const below = !panel.hidden && panel.scrollHeight - panel.clientHeight - panel.scrollTop > 6;
    panel.dataset.more = String(below);
    more.hidden = !below;
    const box = panel.getBoundingClientRect();
    more.style.left = `${box.left + box.width / 2}px`;
    more.style.top = `${box.bottom}px`;
  };
  panel.addEventListener("scroll", look);
  window.addEventListener("resize", look);
  new ResizeObserver(look).observe(panel);
  new MutationObserver(look).observe(panel, { childList: true, subtree: true, characterData: true, attributes: true, attributeFilter: ["hidden"] });
  more.addEventListener("click", () => panel.scrollBy({ top: 0.8 * panel.clientHeight, behavior: "smooth" }));
}

export function notice(message: string): void {
  const box = element("message");
  box.textContent = message;
  box.hidden = false;
}
