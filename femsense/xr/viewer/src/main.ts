// The page: a recorded run, or a stream.

import "./style.css";
import { announceEdges, announceMore, notice, offerHeadset } from "./controls";
import { showStreams } from "./live";
import { element } from "./readout";
import { showRun } from "./recorded";
import { Stage } from "./stage";

main().catch((reason: unknown) => fail(reason instanceof Error ? reason.message : String(reason)));

async function main(): Promise<void> {
  const stage = openStage();
  offerHeadset(stage);
  announceMore();
  announceEdges();
  const live = document.documentElement.dataset.mode === "live";
  const shown = live ? showStreams(stage) : await showRun(stage);
  Object.assign(globalThis, { femsense: { stage, shown } }); // for the console, and for programs that inspect the scene
  document.documentElement.dataset.state = "ready";
}

function openStage(): Stage {
  try {
    return new Stage(element<HTMLCanvasElement>("view"));
  } catch {
    throw new Error("This browser does not give the page WebGL 2.\nSwitch on hardware acceleration, or try another browser.");
  }
}

function fail(message: string): void {
  document.documentElement.dataset.state = "error";
  element("about").textContent = "";
  notice(message);
}
