/** Play controls, and the keys that move the cursor and the visible range. */

import { button, element, notice } from "./dom.js";
import { lastTime, pan, seek, visible, zoom } from "./range.js";
import * as state from "./state.js";
import { moment, offset } from "./words.js";

const RATES = [0.1, 0.2, 0.5, 1, 2, 5, 10];
const UPDATE_MS = 80; // panels cannot follow every frame

const HELP = [
  ["Space", "play or pause"],
  ["← →", "move the cursor; with Shift, in small steps"],
  ["Page Up, Page Down", "move the visible range, in the timeline"],
  ["+ −", "zoom at the cursor; the wheel zooms at the pointer"],
  ["0", "show the whole recording"],
  ["Home, End", "first and last message; a running recording is followed from its end"],
  ["< >", "play slower, faster"],
  ["Drag", "move the visible range; with Shift, zoom to the part that is dragged over"],
  ["/", "ask; Enter asks, Esc leaves"],
  ["n p", "next, previous episode of matches"],
  ["?", "this list"],
];
const SIGNS = [
  ["Bar", "messages in this pixel, on a logarithmic scale; pale if it is an estimate"],
  ["Thin stripes", "gap: no message for more than five usual periods"],
  ["Cross-hatched, framed", "messages were lost"],
  ["Lines", "payloads have expired, or are elsewhere; fields are left"],
  ["Ticks on a lane", "warnings and errors of a log or of diagnostics"],
  ["Flag and dashed line", "mark"],
  ["Band, ticks below the axis", "a question holds, its matches"],
];

/** Adds the controls to an element. Returns a function that takes them away. */
export function mountPlayer(parent, recording) {
  let frame = 0;
  let before = 0;
  let told = 0;
  let at = Number(state.get("at")); // where it plays

  const play = button("Play", "Play or pause (Space)", toggle);
  const rate = element(
    "select",
    { "aria-label": "Speed", title: "Speed (< and >)" },
    ...RATES.map((one) => element("option", { value: String(one), selected: one === 1 }, `${one}×`)),
  );
  const readout = element("output", { class: "readout", "aria-label": "Cursor" });
  const dialog = help();
  const bar = element(
    "div",
    { class: "player", role: "toolbar", "aria-label": "Player" },
    button("⇤", "First message (Home)", () => seek(recording, recording.info.begin)),
    play,
    button("⇥", "Last message (End)", () => seek(recording, lastTime(recording))),
    rate,
    readout,
    element("span", { class: "space" }),
    button("−", "Zoom out (−)", () => zoom(recording, 2, state.get("at"))),
    button("+", "Zoom in (+)", () => zoom(recording, 0.5, state.get("at"))),
    button("All", "Show the whole recording (0)", () => state.set({ begin: null, end: null })),
    button("?", "Keys and signs (?)", () => dialog.showModal()),
  );
  parent.append(bar, dialog);
  const ends = [state.on(["at"], follow)];
  document.addEventListener("keydown", pressed);
  follow();
  return () => {
    pause();
    ends.forEach((end) => end());
    document.removeEventListener("keydown", pressed);
  };

  function follow() {
    const now = state.get("at");
    // Someone else has moved the cursor while it plays.
    if (now !== state.instant(at)) at = Number(now);
    readout.textContent = `${offset(now, 9)}  ${moment(recording.toTime(now), 9)}`;
  }

  function toggle() {
    if (frame) pause();
    else start();
  }

  function start() {
    at = Number(state.get("at"));
    const isAtEnd = state.get("at") >= lastTime(recording);
    if (isAtEnd && recording.info.status !== "open") at = Number(recording.info.begin);
    before = told = performance.now();
    frame = requestAnimationFrame(step);
    play.textContent = "Pause";
  }

  function pause() {
    cancelAnimationFrame(frame);
    frame = 0;
    play.textContent = "Play";
  }

  function step(now) {
    at += (now - before) * 1e6 * Number(rate.value);
    before = now;
    const isOver = at >= lastTime(recording);
    if (isOver) at = Number(lastTime(recording));
    if (isOver || now - told >= UPDATE_MS) {
      told = now;
      seek(recording, isOver ? lastTime(recording) : at);
    }
    if (isOver && recording.info.status !== "open") pause();
    else frame = requestAnimationFrame(step);
  }

  function change(by) {
    rate.selectedIndex = Math.min(Math.max(rate.selectedIndex + by, 0), RATES.length - 1);
    notice(`Speed ${rate.value}×`);
  }

  function pressed(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || dialog.open) return;
    const { target, key } = event;
    if (target.closest("input, textarea, select, [contenteditable]")) return;
    // Elsewhere these scroll the page.
    if (key.startsWith("Page") && !target.closest(".timeline")) return;
    const isButton = target.closest("button, a, summary") !== null;
    if (isButton && (key === " " || key === "Enter")) return;
    const { begin, end } = visible(recording);
    const share = state.instant(Math.ceil((end - begin) / (event.shiftKey ? 1000 : 50)));
    const actions = {
      " ": toggle,
      ArrowLeft: () => seek(recording, state.get("at") - share),
      ArrowRight: () => seek(recording, state.get("at") + share),
      PageUp: () => pan(recording, -0.5),
      PageDown: () => pan(recording, 0.5),
      "+": () => zoom(recording, 0.5, state.get("at")),
      "=": () => zoom(recording, 0.5, state.get("at")),
      "-": () => zoom(recording, 2, state.get("at")),
      0: () => state.set({ begin: null, end: null }),
      Home: () => seek(recording, recording.info.begin),
      End: () => seek(recording, lastTime(recording)),
      "<": () => change(-1),
      ">": () => change(1),
      "?": () => dialog.showModal(),
    };
    if (!Object.hasOwn(actions, key)) return;
    event.preventDefault();
    actions[key]();
  }
}

function help() {
  const rows = (list) =>
    list.flatMap(([name, text]) => [element("dt", {}, name), element("dd", {}, text)]);
  const dialog = element(
    "dialog",
    { class: "help", "aria-label": "Keys and signs" },
    element("h2", {}, "Keys"),
    element("dl", {}, ...rows(HELP)),
    element("h2", {}, "Signs"),
    element("dl", {}, ...rows(SIGNS)),
    element("form", { method: "dialog" }, element("button", { autofocus: true }, "Close")),
  );
  return dialog;
}
