/** The panels at the cursor: a grid, a head for each, and a menu to add one. */

import { copied, element, fill, notice } from "./dom.js";
import { exactRange } from "./range.js";
import * as state from "./state.js";
import image from "./panels/image.js";
import log from "./panels/log.js";
import map from "./panels/map.js";
import message from "./panels/message.js";
import plot from "./panels/plot.js";
import points from "./panels/points.js";

/**
 * The kinds of panels, in the order of the menu.
 *
 * @typedef {Object} Kind
 * @property {string} kind name in addresses
 * @property {string} title name for people
 * @property {function({topic: string, type: string}): boolean} [isFirst] whether a recording is
 *     first shown with one of this topic
 * @property {function({topic: string, type: string, encoding: string}): boolean} accepts
 * @property {function(HTMLElement, Panel): {update: function(), destroy: function()}} mount
 * @property {function(Panel): string} python code that gets the same from the store
 *
 * @typedef {Object} Panel
 * @property {{topic: string, type: string}} topic
 * @property {Object} options the panel's own, kept in the address
 * @property {function(Object)} setOptions changes some of them
 * @property {import("./recording.js").Recording} recording
 * @property {function(): BigInt} cursor ns since the start
 * @property {function(): ?BigInt} seq the arrival number of the message at the cursor that is
 *     meant, if it is one of the topic's; null for the last one
 * @property {function(): {begin: BigInt, end: BigInt}} range the visible one
 * @property {function(number|BigInt)} seek moves the cursor
 */
const KINDS = [image, points, map, plot, log, message];

/** The panels that a recording is first shown with: one of each kind that says so. */
function firstPanels(topics) {
  const found = [];
  for (const { kind, isFirst, accepts } of KINDS) {
    const topic = topics.find((one) => one.messages && accepts(one) && isFirst?.(one));
    if (topic) found.push({ kind, topic: topic.topic, options: {} });
  }
  return found;
}

/**
 * A time early in a recording at which the panels that it is first shown with have a message. If
 * all begin late, it is the first message of any.
 */
export function firstTime({ info }) {
  const names = firstPanels(info.topics).map(({ topic }) => topic);
  const soon = info.begin + (info.end - info.begin) / 10n;
  const times = info.topics
    .filter(({ topic }) => names.includes(topic))
    .map(({ first }) => first)
    .sort((a, b) => (a < b ? -1 : 1));
  const found = times.findLast((first) => first <= soon) ?? times[0] ?? 0n;
  return found < 0n ? 0n : found;
}

/** Shows a panel of a topic: of the first kind that is made for it, unless it is shown already. */
export function openPanel(recording, name) {
  const { topics } = recording.info;
  const topic = topics.find((one) => one.topic === name);
  const kinds = KINDS.filter(({ accepts }) => accepts(topic));
  const { kind } = kinds.find(({ isFirst }) => isFirst?.(topic)) ?? kinds[0];
  const panels = state.get("panels") ?? firstPanels(topics);
  const panel = { kind, topic: name, options: {} };
  if (panels.some((one) => isSame(one, panel))) notice("This panel is shown already.");
  else state.set({ panels: [...panels, panel] });
}

/** Shows the panels of a recording. Returns a function that takes them away. */
export function mountPanels(main, recording) {
  const grid = element("section", { class: "panels", "aria-label": "Panels" });
  const choice = element("select", { "aria-label": "Panel to add" });
  const shown = [];
  let offered = 0; // number of topics in the menu
  main.append(grid, menu());
  draw();
  const ends = [
    state.on(["panels"], draw),
    state.on(["at", "seq", "begin", "end"], update),
    recording.on(draw), // topics may have come
  ];
  return () => {
    ends.forEach((end) => end());
    shown.splice(0).forEach(({ running }) => running?.destroy());
  };

  function update() {
    shown.forEach(({ running }) => running?.update());
  }

  function panels() {
    return state.get("panels") ?? firstPanels(recording.info.topics);
  }

  function topicOf(panel) {
    return recording.info.topics.find((one) => one.topic === panel.topic);
  }

  function draw() {
    offer();
    const wanted = panels();
    // What is shown already stays as it is, so that nothing jumps or loads again.
    const kept = shown.splice(0);
    for (const panel of wanted) {
      const place = kept.findIndex(
        (one) => isSame(one.panel, panel) && Boolean(one.running) === isPossible(panel),
      );
      if (place >= 0) shown.push({ ...kept.splice(place, 1)[0], panel });
      else shown.push(made(panel));
    }
    kept.forEach(({ running }) => running?.destroy());
    const frames = shown.map(({ frame }) => frame);
    // An element that is put in its place anew loses the keyboard, and where it was scrolled to.
    if (frames.some((frame, n) => frame !== grid.children[n]) || frames.length < grid.childElementCount)
      fill(grid, ...frames);
    shown.forEach(({ running }) => running?.update());
  }

  function isPossible(panel) {
    return KINDS.some(({ kind }) => kind === panel.kind) && Boolean(topicOf(panel));
  }

  function made(panel) {
    const kind = KINDS.find((one) => one.kind === panel.kind);
    const topic = topicOf(panel);
    const body = element("div", { class: "body" });
    const close = () => state.set({ panels: panels().filter((one) => !isSame(one, panel)) });
    const copy = () => copied(kind.python(seen));
    const title = kind?.title ?? panel.kind;
    const frame = element(
      "article",
      { class: `panel ${panel.kind}`, "aria-label": `${title} of ${panel.topic}` },
      element(
        "header",
        {},
        element("h2", {}, panel.topic, element("small", {}, ` ${title}`)),
        kind && topic ? element("button", { type: "button", onclick: copy }, "Copy as Python") : null,
        element("button", { type: "button", onclick: close, "aria-label": "Close" }, "×"),
      ),
      body,
    );
    const seen = {
      topic,
      recording,
      get options() {
        return panels().find((one) => isSame(one, panel))?.options ?? {};
      },
      setOptions: (changes) => {
        const merged = (one) =>
          isSame(one, panel) ? { ...one, options: { ...one.options, ...changes } } : one;
        state.set({ panels: panels().map(merged) });
      },
      cursor: () => state.get("at"),
      seq: () => (state.get("ask")?.topic === panel.topic ? state.get("seq") : null),
      range: () => exactRange(recording),
      seek: (at) => state.set({ at }),
    };
    if (!kind || !topic) {
      body.append(element("p", {}, kind ? "This recording has no such topic." : "No such panel."));
      return { panel, frame, running: null };
    }
    return { panel, frame, running: kind.mount(body, seen) };
  }

  /** Fills the menu with a panel of each kind for each topic. */
  function offer() {
    const { topics } = recording.info;
    if (topics.length === offered) return;
    offered = topics.length;
    const options = topics.flatMap((topic) =>
      KINDS.filter(({ accepts }) => accepts(topic)).map(({ kind, title }) => {
        const value = JSON.stringify({ kind, topic: topic.topic, options: {} });
        return element("option", { value }, `${topic.topic} – ${title}`);
      }),
    );
    fill(choice, ...options);
  }

  function menu() {
    const add = () => {
      const panel = JSON.parse(choice.value);
      if (panels().some((one) => isSame(one, panel))) notice("This panel is shown already.");
      else state.set({ panels: [...panels(), panel] });
    };
    return element(
      "p",
      { class: "menu" },
      choice,
      element("button", { type: "button", onclick: add }, "Add panel"),
    );
  }
}

function isSame(a, b) {
  return a.kind === b.kind && a.topic === b.topic;
}
