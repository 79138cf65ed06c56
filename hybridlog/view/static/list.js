/** The list of recordings: search, filter, order, and a bar for what is there and what is lost. */

import { ApiError, Question, isAborted } from "./api.js";
import { element, fill } from "./dom.js";
import * as state from "./state.js";
import { count, counted, duration, moment, size } from "./words.js";

const ROWS = 100;
const MAX_ROWS = 200; // of an answer
const EVERY_MS = 3000;
const REST = 10; // times as long as the last answer took

const COLUMNS = [
  { key: "name", title: "Recording" },
  { key: "start", title: "Start (UTC)" },
  { key: "duration", title: "Duration", isNumber: true },
  { key: "topics", title: "Topics", isNumber: true },
  { key: "messages", title: "Messages", isNumber: true },
  { key: "size", title: "Stored", isNumber: true },
  { key: null, title: "Tags" },
];

const FILTERS = [
  { name: "name", title: "Name", hint: "lab monday*", isWide: true },
  { name: "tag", title: "Tag", hint: "robot=7", isList: true },
  { name: "topic", title: "Topic", hint: "scan", isList: true },
  { name: "type", title: "Type", hint: "sensor_msgs/Imu", isList: true },
  { name: "begin", title: "From", hint: "2026-11-27 10:00" },
  { name: "end", title: "To", hint: "2026-11-27 12:00" },
  { name: "where", title: "With a message", hint: "scan: ranges.min < 0.5", isWide: true, isPredicate: true },
];

/** Shows the list in an element. Returns a function that takes it away. */
export function mountList(main) {
  const order = { key: "start", direction: "down" };
  const inputs = new Map();
  let shown = 0;
  let found = 0;
  let timer = 0;
  let looking = 0; // for what is new
  const asking = new Question();

  const summary = element("p", { class: "summary", "aria-live": "polite" }, "…");
  const body = element("tbody");
  const head = element("tr");
  const more = element("button", { type: "button", onclick: () => load(true) }, "Show more");
  const problem = element("pre", { class: "problem", role: "alert", hidden: true });
  const form = element(
    "form",
    { class: "filters", role: "search", onsubmit: (event) => event.preventDefault() },
    ...FILTERS.map(filter),
  );
  main.append(
    form,
    problem,
    summary,
    element(
      "div",
      { class: "scrolls" },
      element("table", { class: "recordings" }, element("thead", {}, head), body),
    ),
    more,
  );

  function filter({ name, title, hint, isWide, isPredicate }) {
    const input = element("input", {
      name,
      placeholder: hint,
      autocomplete: "off",
      spellcheck: "false",
      type: "search",
      // A predicate may take long, and makes no sense before it is finished.
      [isPredicate ? "onchange" : "oninput"]: () => {
        clearTimeout(timer);
        timer = setTimeout(() => load(false), 200);
      },
    });
    inputs.set(name, input);
    return element("label", { class: isWide ? "wide" : "" }, title, input);
  }

  function drawHead() {
    fill(
      head,
      ...COLUMNS.map(({ key, title, isNumber }) => {
        const isSorted = key === order.key;
        const sorted = { up: "ascending", down: "descending" }[order.direction];
        const cell = { class: isNumber ? "number" : "", scope: "col" };
        if (key === null) return element("th", cell, title);
        const press = () => {
          order.direction = isSorted && order.direction === "down" ? "up" : "down";
          order.key = key;
          load(false);
        };
        const arrow = isSorted ? { up: " ↑", down: " ↓" }[order.direction] : "";
        return element(
          "th",
          { ...cell, "aria-sort": isSorted ? sorted : "none" },
          element("button", { type: "button", class: "plain", onclick: press }, title + arrow),
        );
      }),
    );
  }

  function conditions() {
    const asked = {};
    for (const { name, isList } of FILTERS) {
      const text = inputs.get(name).value.trim();
      if (text) asked[name] = isList ? text.split(/[\s,]+/) : text;
    }
    return asked;
  }

  async function load(isMore, isNew = true) {
    clearTimeout(looking);
    drawHead();
    const first = isMore ? shown : 0;
    const rows = isNew ? ROWS : Math.max(shown, ROWS);
    more.hidden = !isMore;
    if (!isMore && isNew) summary.textContent = "…";
    const asked = { ...conditions(), order: order.key, direction: order.direction, first, count: rows };
    const begun = performance.now();
    try {
      const answer = await asking.ask("recordings", asked);
      const focused = body.contains(document.activeElement) && document.activeElement.href;
      if (!isMore) fill(body);
      body.append(...answer.rows.map(row));
      [...body.querySelectorAll("a")].find((link) => link.href === focused)?.focus();
      shown = first + answer.rows.length;
      found = answer.found;
      problem.hidden = true;
      summary.textContent = summaryOf(answer);
    } catch (error) {
      if (isAborted(error)) return;
      if (!(error instanceof ApiError)) throw error;
      problem.hidden = false;
      problem.textContent = error.message;
    }
    more.hidden = shown >= found;
    looking = setTimeout(look, EVERY_MS + REST * (performance.now() - begun));
  }

  /** Recordings that were made since are in the list, too. */
  function look() {
    if (document.hidden || shown > MAX_ROWS) looking = setTimeout(look, EVERY_MS);
    else load(false, false);
  }

  drawHead();
  load(false);
  inputs.get("name").focus({ preventScroll: true });
  return () => {
    clearTimeout(timer);
    clearTimeout(looking);
    asking.stop();
  };
}

function summaryOf(answer) {
  if (!answer.all) return "The store is empty: hybridlog record FILE fills it.";
  const which = answer.found === answer.all ? "" : ` of ${count(answer.all)}`;
  const content = `${counted(answer.messages, "message")}, ${size(answer.bytes)}`;
  const noun = answer.all === 1 ? "recording" : "recordings";
  return `${count(answer.found)}${which} ${noun}: ${content}.`;
}

function row(one) {
  const open = (event) => {
    if (event.metaKey || event.ctrlKey) return;
    event.preventDefault();
    state.show(one.name);
  };
  const link = element("a", { href: state.link({ recording: one.name }), onclick: open }, one.name);
  const status = STATUS[one.status];
  const lost = one.incomplete && "messages lost";
  const badges = [status, lost].filter(Boolean).map((text) => element("span", { class: "badge" }, text));
  const tags = Object.entries(one.tags).map(([key, value]) =>
    element("span", { class: "tag" }, value ? `${key}=${value}` : key),
  );
  return element(
    "tr",
    {},
    element("th", { scope: "row" }, link, ...badges),
    element("td", { class: "time" }, moment(BigInt(one.start), 0)),
    element("td", { class: "number" }, duration(one.duration)),
    element("td", { class: "number" }, count(one.topics)),
    element("td", { class: "number" }, count(one.messages)),
    element("td", { class: "number" }, size(one.bytes)),
    element("td", {}, ...tags),
  );
}

const STATUS = {
  open: "being recorded",
  damaged: "damaged",
  recovered: "cut short",
  unfinished: "cut short",
  unproven: "manifest lost",
};

