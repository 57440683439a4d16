// Buttons and keys that a recorded run and a stream have in common.

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
      (yes) => (button.hidden = !yes),
      () => (button.hidden = true),
    );
    button.addEventListener("click", () => stage.enter(mode).catch((e: Error) => notice(`The headset did not open: ${e.message}`)));
  }
}

export function notice(message: string): void {
  const box = element("message");
  box.textContent = message;
  box.hidden = false;
}
