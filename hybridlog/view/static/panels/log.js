/** Lines of a text log around the cursor; only those that can be seen are elements. */

import { ApiError, Question, isAborted } from "../api.js";
import { element, fill } from "../dom.js";
import { instant } from "../state.js";
import { counted, offset } from "../words.js";
import { literal, moment, opening } from "./python.js";
import { ofTypes } from "./types.js";

const accepts = ofTypes(
  "rosgraph_msgs/Log",
  "rcl_interfaces/Log",
  "foxglove_msgs/Log",
  "foxglove.Log",
  "std_msgs/String",
);
const LEVELS = ["debug", "info", "warning", "error", "fatal"];
/** Field with the text and the least number of each level by type. */
const KINDS = {
  "rosgraph_msgs/Log": ["msg", [1, 2, 4, 8, 16]],
  "rcl_interfaces/Log": ["msg", [10, 20, 30, 40, 50]],
  "foxglove_msgs/Log": ["message", [1, 2, 3, 4, 5]],
  "foxglove.Log": ["message", [1, 2, 3, 4, 5]],
  "std_msgs/String": ["data", null],
};
const ROW = 22; // pixels; the style sheet says the same
const PAGE = 200; // lines of a request
const MAX_LINES = 2000;
const BEYOND = 10; // lines above and below what is seen
const TYPING = 250; // ms
const MAX_CHARACTERS = 4000; // of a line

export default {
  kind: "log",
  title: "Log",
  isFirst: () => true,
  accepts,
  mount,
  python: (panel) => {
    const { level, text } = filtersOf(panel.options);
    const where = conditions(panel.topic.type, level, text);
    const { begin, end } = panel.range();
    const { recording } = panel;
    return [
      opening(panel),
      `query = query.between(${moment(recording, begin)}, ${moment(recording, end)})`,
      ...(where ? [`query = query.where(${literal(where)})`] : []),
      "for message in query.limit(1000):",
      "    print(message.log_time_ns, message.fields)",
    ].join("\n");
  },
};

/** The predicate for the lines that the filters let pass; empty for all. */
function conditions(type, level, text) {
  const [field, numbers] = KINDS[type.replace("/msg/", "/")];
  const found = [];
  if (level && numbers) found.push(`level >= ${numbers[LEVELS.indexOf(level)]}`);
  if (text) {
    // Written as numbers, characters mean nothing to the pattern nor to the predicate.
    const plain = (c) => (/[\p{L}\p{N}]/u.test(c) ? c : `\\x{${c.codePointAt(0).toString(16)}}`);
    const pattern = `"(?i)${[...text].map(plain).join("")}"`;
    const fields = numbers ? [field, "name"] : [field];
    found.push(fields.map((one) => `${one} ~ ${pattern}`).join(" or "));
  }
  return found.map((one) => `(${one})`).join(" and ");
}

/** A text that the server has cut has one character more. */
function cut(text) {
  return text.length > MAX_CHARACTERS ? `${text.slice(0, MAX_CHARACTERS)}…` : text;
}

function filtersOf({ level, text }) {
  return {
    level: LEVELS.includes(level) ? level : "",
    text: typeof text === "string" ? text.slice(0, 200) : "",
  };
}

function mount(body, panel) {
  const [asking, counting] = [new Question(), new Question()];
  const asked = { recording: panel.recording.info.id, topic: panel.topic.topic };
  const [field, numbers] = KINDS[panel.topic.type.replace("/msg/", "/")];
  const fields = numbers ? [field, "name", "level"] : [field];
  let lines = [];
  let isFirst = true; // no line is before these
  let isLast = true;
  let isLoading = false;
  let current = -1; // place of the line at the cursor
  let at = null;
  let isGone = false;
  let typing = 0;
  let known = {}; // the recording when it was asked

  const level = element(
    "select",
    { "aria-label": "Least level", onchange: () => panel.setOptions({ level: level.value }) },
    element("option", { value: "" }, "all levels"),
    ...LEVELS.map((name) => element("option", { value: name }, name)),
  );
  const text = element("input", {
    type: "search",
    placeholder: "Text",
    "aria-label": "Text",
    maxlength: 200,
    oninput: () => {
      clearTimeout(typing);
      typing = setTimeout(() => panel.setOptions({ text: text.value }), TYPING);
    },
  });
  const number = element("small", { role: "status" });
  const inside = element("div", { class: "inside", role: "list" });
  const view = element(
    "div",
    { class: "lines", tabindex: "0", "aria-label": "Lines", onscroll: scrolled, onkeydown: moved },
    inside,
  );
  const whole = element("div", { class: "whole" });
  body.append(
    element("div", { class: "filters-line" }, numbers ? level : null, text, number),
    view,
    whole,
  );
  let filters = filtersOf(panel.options);
  showFilters();
  const watching = new ResizeObserver(() => draw());
  watching.observe(view);
  load();

  function showFilters() {
    level.value = filters.level;
    if (text.value !== filters.text) text.value = filters.text;
  }

  /** Lines around the cursor, in the place of all others. */
  async function load() {
    at = panel.cursor();
    known = { ...panel.recording.info, start: panel.recording.start };
    isLoading = true;
    const parameters = { ...asked, where: chosen(), field: fields, at, before: PAGE / 2, after: PAGE / 2 };
    await answered(asking.ask("rows", parameters), (found) => {
      [lines, isFirst, isLast] = [found.rows, found.first, found.last];
      isLoading = false;
      point(true);
      if (panel.cursor() !== at) update();
    });
    if (!isGone) tally();
  }

  let tallied = ""; // the filters of the number
  let isGrown = false; // since then

  /** How many lines pass the filters. */
  async function tally() {
    const now = JSON.stringify(filters);
    if (now === tallied && !isGrown) return;
    const ask = now === tallied ? "update" : "ask";
    [tallied, isGrown] = [now, false];
    if (ask === "ask") number.textContent = "…";
    await answered(counting[ask]("ask", { ...asked, where: chosen() }), (found) => {
      number.textContent = counted(found.count, "line");
    });
  }

  function chosen() {
    return conditions(panel.topic.type, filters.level, filters.text);
  }

  /** More lines at one end; the others stay where they are seen. */
  async function more(isBefore) {
    const edge = isBefore ? lines[0] : lines.at(-1);
    if (isLoading || !edge) return;
    isLoading = true;
    const parameters = { ...asked, where: chosen(), field: fields, at: edge.time, seq: edge.seq };
    parameters[isBefore ? "before" : "after"] = PAGE;
    await answered(asking.ask("rows", parameters), (found) => {
      isLoading = false;
      if (isBefore) {
        lines = [...found.rows, ...lines];
        isFirst = found.first;
        view.scrollTop += found.rows.length * ROW;
        if (lines.length > MAX_LINES) isLast = false;
        lines = lines.slice(0, MAX_LINES);
      } else {
        lines = [...lines, ...found.rows];
        isLast = found.last;
        const surplus = Math.max(lines.length - MAX_LINES, 0);
        if (surplus) isFirst = false;
        lines = lines.slice(surplus);
        view.scrollTop -= surplus * ROW;
      }
      point(false);
    });
    if (!isGone) tally();
  }

  async function answered(request, use) {
    try {
      const found = await request;
      for (const line of found.rows ?? []) Object.assign(line, readable(line));
      if (!isGone) use(found);
    } catch (error) {
      if (isGone || isAborted(error)) return;
      if (!(error instanceof ApiError)) throw error;
      isLoading = false;
      lines = [];
      number.textContent = "";
      fill(inside, element("pre", { class: "problem", role: "alert" }, error.message));
    }
  }

  /** What a line shows: a text, and where it has them the name of the sender and a level. */
  function readable({ time, values, problem }) {
    const [text, name, level] = values ?? [problem];
    const known = LEVELS.filter((_, place) => numbers && level >= numbers[place]);
    return { time: instant(time), text: String(text), name, level: known.at(-1) };
  }

  function update() {
    const wanted = filtersOf(panel.options);
    if (JSON.stringify(wanted) !== JSON.stringify(filters)) {
      filters = wanted;
      showFilters();
      return load();
    }
    const { info, start } = panel.recording;
    if (start !== known.start) return load();
    if (info.messages !== known.messages) grown();
    if (panel.cursor() === at) return undefined;
    at = panel.cursor();
    const isThere =
      lines.length && (isFirst || lines[0].time <= at) && (isLast || at < lines.at(-1).time);
    if (isThere) point(true);
    else if (!isLoading) load();
    return undefined;
  }

  /** Lines may have come at the end of a recording that goes on. */
  function grown() {
    known = { ...panel.recording.info, start: panel.recording.start };
    isGrown = true;
    if (isLoading) return;
    if (!lines.length) load();
    else if (isLast) more(false);
    else tally();
  }

  /** Finds the line at the cursor, and with `isMoved` brings it into view. */
  function point(isMoved) {
    let place = lines.length - 1;
    while (place >= 0 && lines[place].time > at) place -= 1;
    current = place;
    inside.style.height = `${lines.length * ROW}px`;
    if (isMoved) {
      const top = Math.max(current, 0) * ROW;
      const isSeen = top >= view.scrollTop && top + ROW <= view.scrollTop + view.clientHeight;
      if (!isSeen) view.scrollTop = top - view.clientHeight / 2;
    }
    draw();
  }

  function draw() {
    if (isGone) return;
    const first = Math.max(Math.floor(view.scrollTop / ROW) - BEYOND, 0);
    const seen = Math.ceil(view.clientHeight / ROW) + 2 * BEYOND;
    const rows = lines.slice(first, first + seen).map((line, n) => rowOf(line, first + n));
    if (!lines.length && !isLoading) rows.push(element("p", {}, "No such lines."));
    fill(inside, ...rows);
    const line = lines[current];
    whole.textContent = line ? cut(line.text) : "";
  }

  function rowOf(line, place) {
    const row = element(
      "div",
      {
        class: `line ${line.level ?? ""}${line.problem ? " unreadable" : ""}`,
        role: "listitem",
        "aria-current": place === current ? "true" : null,
        title: line.text,
        onclick: () => panel.seek(line.time),
      },
      element("span", { class: "time" }, offset(line.time)),
      numbers ? element("span", { class: "level" }, line.level ?? "") : null,
      line.name ? element("span", { class: "name" }, line.name) : null,
      element("span", { class: "text" }, cut(line.text).replaceAll("\n", " ⏎ ")),
    );
    row.style.top = `${place * ROW}px`;
    return row;
  }

  function scrolled() {
    draw();
    const near = PAGE / 4 * ROW;
    if (!isFirst && view.scrollTop < near) more(true);
    else if (!isLast && view.scrollTop + view.clientHeight > lines.length * ROW - near) more(false);
  }

  /** The arrows step from one time to the next that has lines. */
  function moved(event) {
    if (event.key !== "ArrowUp" && event.key !== "ArrowDown") return;
    event.preventDefault();
    event.stopPropagation();
    let place = current + 1;
    if (event.key === "ArrowUp") {
      place = current - 1;
      while (place >= 0 && lines[place].time === lines[current].time) place -= 1;
    }
    if (lines[place]) panel.seek(lines[place].time);
  }

  return {
    update,
    destroy() {
      isGone = true;
      asking.stop();
      counting.stop();
      clearTimeout(typing);
      watching.disconnect();
    },
  };
}
