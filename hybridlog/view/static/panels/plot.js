/** Fields over time: each value where there are few, else least and greatest by pixel. */

import { ApiError, Question, isAborted } from "../api.js";
import { element, fill } from "../dom.js";
import { show } from "../range.js";
import * as state from "../state.js";
import uPlot from "../vendor/uPlot.esm.js";
import { literal, moment, opening } from "./python.js";

const USUAL_FIELDS = 3;
const FIRST = "ranges.min"; // how near something is
const MAX_FIELDS = 16;
const FIRST_PIXELS = 200; // of the picture that tells which fields move
const COLOURS = 8; // classes `series-0` and so on of the style sheet
const MAX_PIXELS = 4096;
const SHARED_CURSOR = "time";
const LETTER = 7; // pixels of a digit of a label
const LEAST_DRAG = 5; // pixels; less is a click

export default {
  kind: "plot",
  title: "Plot",
  accepts: () => true,
  mount,
  python: (panel) => {
    const { begin, end } = panel.range();
    const [from, to] = [moment(panel.recording, begin), moment(panel.recording, end)];
    // Tables have whole arrays as columns.
    const names = (fieldsOf(panel.options) ?? []).map((name) => name.replace(/\[\d+\]$/, ""));
    const fields = [...new Set(names)].map(literal).join(", ");
    return [
      opening(panel),
      `query = query.between(${from}, ${to})`,
      `frame = query${fields && `.fields(${fields})`}.to_pandas()`,
      "print(frame)",
    ].join("\n");
  },
};

/** The fields that the options of a panel name; null if they name none. */
function fieldsOf({ fields }) {
  if (!Array.isArray(fields)) return null;
  return fields.filter((one) => typeof one === "string").slice(0, MAX_FIELDS);
}

function mount(body, panel) {
  const [asking, naming] = [new Question(), new Question()];
  const asked = { recording: panel.recording.info.id, topic: panel.topic.topic };
  const legend = element("div", { class: "legend" });
  const place = element("div", { class: "chart" });
  const problem = element("pre", { class: "problem", role: "alert", hidden: true });
  let chart = null;
  let drawn = null; // the answer that is drawn
  let wanted = ""; // what was asked for last
  let known = [];
  let isGone = false;

  const picker = fieldPicker((path) => {
    const names = fields();
    if (!names.includes(path)) panel.setOptions({ fields: [...names, path].slice(0, MAX_FIELDS) });
  });
  body.append(element("div", { class: "legend-line" }, legend, picker.dom), problem, place);
  const line = element("div", { class: "cursor-line" });
  const watching = new ResizeObserver(resized);
  watching.observe(place);
  const scheme = matchMedia("(prefers-color-scheme: dark)");
  scheme.addEventListener("change", redraw);
  load();

  async function load() {
    try {
      const found = await naming.ask("fields", asked);
      if (isGone) return;
      known = found.fields;
      if (!fieldsOf(panel.options)) panel.setOptions({ fields: await moving(usual(known)) });
      if (isGone) return;
      showLegend();
      update();
    } catch (error) {
      refuse(error);
    }
  }

  /** The first of some fields whose values are not the same all the time; else the first ones. */
  async function moving(names) {
    if (names.length < 2) return names;
    const { begin, end } = panel.recording.info;
    const whole = { begin, end: end > begin ? end : begin + 1n, pixels: FIRST_PIXELS };
    const found = await naming.ask("series", { ...asked, field: names, ...whole });
    const moves = ({ least, greatest }) => {
      const values = [...least, ...(greatest ?? [])].filter((value) => value !== null);
      return values.some((value) => value !== values[0]);
    };
    const some = found.fields.filter(moves).map(({ field }) => field);
    return (some.length ? some : names).slice(0, USUAL_FIELDS);
  }

  function fields() {
    return fieldsOf(panel.options) ?? [];
  }

  function typeOf(field) {
    return known.find(({ path }) => path === field)?.type;
  }

  function update() {
    if (!isGone && place.clientWidth) ask();
    showCursor();
  }

  /** Asks for the visible range, if it is not what was asked for last. */
  async function ask() {
    const { begin, end } = panel.range();
    const names = fields();
    const pixels = Math.min(Math.max(Math.round(place.clientWidth), 1), MAX_PIXELS);
    const { info, start } = panel.recording;
    const isOpen = info.status === "open";
    const now = JSON.stringify([`${begin} ${end} ${start}`, names, pixels, isOpen && info.messages]);
    if (now === wanted) return;
    wanted = now;
    chart?.setScale("x", scaleOf(panel.range())); // at once, with the values that are there
    showLegend();
    if (!names.length) return drawAnswer({ times: [], fields: [], exact: true });
    try {
      const parameters = { ...asked, field: names, begin, end, pixels };
      const answer = await asking[panel.recording.isUpdating ? "update" : "ask"]("series", parameters);
      if (isGone) return;
      problem.hidden = true;
      drawAnswer({ ...answer, times: answer.times.map(state.instant) });
    } catch (error) {
      refuse(error);
    }
  }

  function refuse(error) {
    if (isGone || isAborted(error)) return;
    if (!(error instanceof ApiError)) throw error;
    problem.textContent = error.message;
    problem.hidden = false;
    drawAnswer({ times: [], fields: [], exact: true });
  }

  function drawAnswer(answer) {
    const isAlike = drawn && namesOf(drawn) === namesOf(answer);
    drawn = answer;
    if (isAlike && chart) chart.setData(dataOf(answer), false);
    else redraw();
    chart.batch(() => {
      chart.setScale("x", scaleOf(panel.range()));
      chart.setScale("y", heightOf(answer));
    });
    showCursor();
    place.dataset.exact = answer.exact; // for tests and for style
  }

  function redraw() {
    if (!drawn) return;
    chart?.destroy();
    chart = new uPlot(optionsOf(), dataOf(drawn), place);
    chart.setScale("x", scaleOf(panel.range()));
    chart.setScale("y", heightOf(drawn));
    chart.over.append(line);
    chart.over.addEventListener("click", clicked);
    showCursor();
  }

  function optionsOf() {
    const colours = colourReader(place);
    const axis = { stroke: colours.text, grid: { stroke: colours.line, width: 1 } };
    const ticks = { stroke: colours.line, width: 1, size: 4 };
    return {
      width: Math.max(place.clientWidth, 50),
      height: Math.max(place.clientHeight, 50),
      legend: { show: false },
      scales: { x: { time: false, auto: false }, y: { auto: false } },
      axes: [
        { ...axis, ticks, size: 28, values: (_, splits) => splits.map((ns) => timeText(ns)) },
        { ...axis, ticks, size: roomFor },
      ],
      cursor: {
        y: false,
        drag: { x: true, y: false, setScale: false, dist: LEAST_DRAG },
        sync: { key: SHARED_CURSOR, scales: ["x", null], setSeries: false },
        bind: { dblclick: () => () => state.set({ begin: null, end: null }) },
        points: { show: drawn.exact },
      },
      hooks: { setSelect: [selected], setCursor: [showValues] },
      series: [
        {},
        ...drawn.fields.flatMap((_, place) => {
          const stroke = colours.series(place);
          const shared = { stroke, width: 1.5, spanGaps: false };
          // Values that have no neighbours are points, and many are too close to be told apart.
          return [shared, { ...shared, points: { show: false } }];
        }),
      ],
      bands: drawn.fields.map((_, place) => ({
        series: [2 * place + 2, 2 * place + 1],
        fill: colours.band(place),
      })),
    };
  }

  function selected() {
    const { left, width } = chart.select;
    if (width < LEAST_DRAG) return;
    const [begin, end] = [left, left + width].map((at) => Math.round(chart.posToVal(at, "x")));
    chart.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
    show(panel.recording, begin, end);
  }

  function clicked(event) {
    const [from] = pressedAt ?? [];
    if (from !== undefined && Math.abs(event.clientX - from) >= LEAST_DRAG) return;
    const { left } = chart.over.getBoundingClientRect();
    panel.seek(chart.posToVal(event.clientX - left, "x"));
  }

  let pressedAt = null;
  place.addEventListener("mousedown", (event) => (pressedAt = [event.clientX]));

  function resized() {
    if (isGone || !place.clientWidth) return;
    chart?.setSize({ width: place.clientWidth, height: Math.max(place.clientHeight, 50) });
    update();
  }

  /** A line where the cursor is, and the values there. */
  function showCursor() {
    if (!chart) return;
    const at = panel.cursor();
    const { begin, end } = panel.range();
    line.hidden = at < begin || at > end;
    line.style.transform = `translateX(${chart.valToPos(Number(at), "x")}px)`;
    if (chart.cursor.left === undefined || chart.cursor.left < 0) showValues();
  }

  function showLegend() {
    const names = fields();
    const chips = names.map((name, place) =>
      element(
        "span",
        { class: `chip series-${place % COLOURS}` },
        element("span", { class: "name", title: name }, name),
        element("output", { "data-field": name, "aria-live": "off" }, ""),
        element(
          "button",
          {
            type: "button",
            class: "plain",
            "aria-label": `Remove ${name}`,
            onclick: () => panel.setOptions({ fields: fields().filter((one) => one !== name) }),
          },
          "×",
        ),
      ),
    );
    fill(legend, ...chips);
    picker.set(known);
  }

  /** The values below the mouse, or else at the cursor. */
  function showValues() {
    if (!drawn || !chart) return;
    const { left, idx } = chart.cursor;
    const isHovered = left !== undefined && left >= 0 && idx !== null && idx !== undefined;
    const place = isHovered ? idx : placeAt(drawn.times, panel.cursor());
    drawn.fields.forEach((one) => {
      const output = legend.querySelector(`output[data-field="${CSS.escape(one.field)}"]`);
      if (!output) return;
      output.textContent = place < 0 ? "" : valueText(one, place, typeOf(one.field));
      output.title = output.textContent; // if it is cut
    });
  }

  return {
    update,
    destroy() {
      isGone = true;
      asking.stop();
      naming.stop();
      watching.disconnect();
      scheme.removeEventListener("change", redraw);
      chart?.destroy();
    },
  };
}

function namesOf({ fields, exact }) {
  return JSON.stringify([exact, ...fields.map(({ field }) => field)]);
}

/** Numbers to draw; integers that these are too coarse for are texts in an answer. */
function dataOf({ times, fields }) {
  const drawn = (values) => values.map((value) => (value === null ? null : Number(value)));
  return [times, ...fields.flatMap(({ least, greatest }) => [least, greatest ?? least])].map(drawn);
}

function scaleOf({ begin, end }) {
  return { min: Number(begin), max: Number(end) };
}

/** The range of all values, with a little room. */
function heightOf({ fields }) {
  let [low, high] = [Infinity, -Infinity];
  for (const { least, greatest } of fields) {
    for (const value of least) if (value !== null && value < low) low = Number(value);
    for (const value of greatest ?? least) if (value !== null && value > high) high = Number(value);
  }
  if (low > high) return { min: 0, max: 1 };
  const room = high > low ? (high - low) * 0.05 : Math.abs(high) * 0.05 || 1;
  return { min: low - room, max: high + room };
}

/** The last entry not after a time; -1 if there is none. */
function placeAt(times, at) {
  let [low, high] = [0, times.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= at) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

function valueText({ least, greatest }, place, type) {
  const [low, high] = [least[place], (greatest ?? least)[place]];
  if (low === null) return "–";
  return low === high ? numberText(low, type) : `${numberText(low, type)} … ${numberText(high, type)}`;
}

/** The shortest digits that give a value back in its type. */
function numberText(value, type) {
  const isShort = type === "float32" || type === "summary";
  if (!isShort || Number.isInteger(value) || Math.fround(value) !== value) return String(value);
  let digits = 1;
  while (Math.fround(value.toPrecision(digits)) !== value) digits += 1;
  return String(Number(value.toPrecision(digits)));
}

let pickers = 0;

/** A field to add the path of a number in, completed by the browser; `choose` is told the path. */
function fieldPicker(choose) {
  const id = `fields-${(pickers += 1)}`;
  const list = element("datalist", { id });
  const add = () => {
    const path = input.value.trim();
    input.value = "";
    if (path) choose(path);
  };
  const input = element("input", {
    list: id,
    type: "search",
    placeholder: "Add a field",
    "aria-label": "Add a field",
    autocomplete: "off",
    onchange: add,
  });
  return {
    dom: element("span", { class: "picker" }, input, list),
    set: (fields) =>
      fill(list, ...fields.map(({ path, type }) => element("option", { value: path }, type))),
  };
}

/** Room for the longest label of an axis, pixels. */
function roomFor(_, labels) {
  return Math.max(56, ...(labels ?? []).map((label) => 20 + LETTER * label.length));
}

function timeText(ns) {
  return `${Number((ns / 1e9).toPrecision(12))} s`;
}

/** Fields to begin with: those that a robotics engineer would look at first. */
function usual(known) {
  if (known.some(({ path }) => path === FIRST)) return [FIRST];
  const isPlain = ({ path, type }) => type !== "summary" && !/\[|^header\./.test(path);
  const isNumber = ({ type }) => !/time|duration/.test(type);
  const lists = [known.filter((one) => isPlain(one) && isNumber(one)), known.filter(isPlain), known];
  const found = lists.find((list) => list.length) ?? [];
  return found.slice(0, MAX_FIELDS).map(({ path }) => path);
}

/** Colours of the style sheet, as a canvas needs them. */
function colourReader(place) {
  const probe = element("span", { hidden: true });
  place.append(probe);
  const colour = (name, property) => {
    probe.className = name;
    return getComputedStyle(probe)[property];
  };
  const series = Array.from({ length: COLOURS }, (_, n) => colour(`series-${n}`, "color"));
  const found = {
    text: colour("plot-axis", "color"),
    line: colour("plot-axis", "borderTopColor"),
    series: (n) => series[n % COLOURS],
    band: (n) => series[n % COLOURS].replace(/^rgb\((.*)\)$/, "rgba($1, 0.35)"),
  };
  probe.remove();
  return found;
}
