/** Starts the page: the list of recordings, or one of them. */

import { fill } from "./dom.js";
import * as state from "./state.js";
import { mountList } from "./list.js";
import { mountRecording } from "./recording.js";

let unmount = () => {};

function show() {
  unmount();
  const main = document.getElementById("main");
  fill(main);
  const label = state.get("recording");
  document.title = label ? `${label} – hybridlog` : "hybridlog";
  document.getElementById("where").textContent = label;
  unmount = label ? mountRecording(main, label) : mountList(main);
}

document.getElementById("home").addEventListener("click", (event) => {
  event.preventDefault();
  state.show("");
});
state.start();
state.on(["recording"], show);
show();
