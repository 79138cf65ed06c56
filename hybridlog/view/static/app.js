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
  const name = state.get("recording");
  document.title = name ? `${name} – hybridlog` : "hybridlog";
  document.getElementById("where").textContent = name;
  unmount = name ? mountRecording(main, name) : mountList(main);
}

document.getElementById("home").addEventListener("click", (event) => {
  event.preventDefault();
  state.show("");
});
state.start();
state.on(["recording"], show);
show();
