// Buttons and keys that a recorded run and a stream have in common.

import { Alignment, enough, type Landmark } from "./alignment";
import type { Body } from "./body";
import { PAINTS, type Paint } from "./paint";
import { element } from "./readout";
import type { Stage } from "./stage";

/** Makes a button that is on or off; returns what its key does. */
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

/** Connects the choice of what colours the body; returns what its key does. */
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

/** Says below the panel's figures what the colours mean. */
export function paintLegend(paint: Paint, body: Body | null, stress = ""): void {
  const said = { none: "", motion: body ? `${(1000 * body.motionScale).toPrecision(2)} mm of motion` : "", stress, contact: "contact likely" }[paint];
  element("scale").hidden = !said;
  element("scale-top").textContent = said;
}

/** In AR, and where `Align` is on, lays the twin over the real robot: the person touches its markers and cameras in turn. */
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

/** Shows the ways into a headset where there are any. */
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

/** Says to the styles how tall the bar is: other things stand on it. */
export function announceDock(): void {
  const dock = element("dock");
  new ResizeObserver(() => document.documentElement.style.setProperty("--dock", `${dock.offsetHeight}px`)).observe(dock);
}

/** Shows, where the panel is longer than its place, that there is more below. */
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
