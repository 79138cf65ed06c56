/** Charts of one page: zoom by dragging in any of them, back by a double click. */

const COLOURS = [
  "#1f77b4", "#ff7f0e", "#2ca02c", "#d62728", "#9467bd",
  "#8c564b", "#e377c2", "#7f7f7f", "#bcbd22", "#17becf",
];
const HEIGHT = 300;
const SECONDS = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 21600, 43200];
const STEPS = [
  ...[-9, -8, -7, -6, -5, -4, -3, -2, -1].flatMap((n) => [1, 2, 5].map((k) => Number(`${k}e${n}`))),
  ...SECONDS,
  ...[1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 10000].map((days) => days * 86400),
];

const charts = JSON.parse(document.getElementById("data").textContent);
const style = getComputedStyle(document.documentElement);
const joined = charts.map(({ tables }) => uPlot.join(tables.map(dataOf)));
const whole = [
  Math.min(...joined.map(([times]) => times[0] ?? Infinity)),
  Math.max(...joined.map(([times]) => times.at(-1) ?? -Infinity)),
];
charts.forEach((chart, number) => show(chart, joined[number]));

function show({ title, tables }, data) {
  const heading = document.createElement("h2");
  heading.textContent = title;
  const place = document.createElement("div");
  document.body.append(heading, place);
  const lines = tables.flatMap((table) => table.lines);
  const axis = { stroke: style.color, grid: { stroke: "#8884" }, ticks: { stroke: "#8884" } };
  const options = {
    width: place.clientWidth,
    height: HEIGHT,
    scales: { x: { time: false, range: (chart, low, high) => range(data[0], low, high) } },
    axes: [
      { ...axis, incrs: STEPS, values: (chart, ticks) => labels(ticks) },
      { ...axis, size: 80, values: (chart, ticks, _, __, step) => amounts(ticks, step) },
    ],
    cursor: { sync: { key: "time" }, drag: { x: true, y: false } },
    series: [
      { label: "time", value: (chart, time) => (time == null ? "-" : `+${time.toFixed(6)} s`) },
      ...lines.map((line, number) => ({
        label: line.name,
        stroke: COLOURS[number % COLOURS.length],
        dash: number < COLOURS.length ? undefined : [6, 4],
        width: 1.25,
        points: { show: true, size: 4, fill: COLOURS[number % COLOURS.length], filter: marked },
        value: (chart, value) => (value == null ? "-" : String(value)),
      })),
    ],
  };
  const made = new uPlot(options, data, place);
  new ResizeObserver(() => made.setSize({ width: place.clientWidth, height: HEIGHT })).observe(place);
}

/** The visible times: all charts have the same when nothing is zoomed in. */
function range(times, low, high) {
  return low === times[0] && high === times.at(-1) ? whole : [low, high];
}

/** Digits behind the point that numbers need. */
function digitsOf(ticks) {
  return Math.max(0, ...ticks.map((tick) => (String(+tick.toFixed(9)).split(".")[1] ?? "").length));
}

/** Numbers on the vertical axis. */
function amounts(ticks, step) {
  const isPlain = step >= 1e-6 && Math.max(...ticks.map(Math.abs)) < 1e9;
  const digits = digitsOf(ticks);
  return ticks.map((tick) => (isPlain ? tick.toFixed(digits) : String(+tick.toPrecision(12))));
}

/** Times and values of a recording; null is a gap. */
function dataOf({ times, lines }) {
  const values = lines.map((line) => Array.from(numbers(line.values), (y) => (Number.isFinite(y) ? y : null)));
  return [Array.from(numbers(times)), ...values];
}

function numbers(text) {
  return new Float64Array(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);
}

/** The values that are drawn as points: all where they are few, else those between two gaps. */
function marked(chart, number) {
  const [values, [first, last]] = [chart.data[number], chart.series[number].idxs];
  if (last - first < chart.bbox.width / devicePixelRatio / 12) return null;
  const found = [];
  for (let i = first; i <= last; i++) {
    if (values[i] != null && isGap(values, i, -1) && isGap(values, i, 1)) found.push(i);
  }
  return found;
}

/** Whether there is a gap beside a value. Undefined is a time of another recording. */
function isGap(values, at, step) {
  do at += step; while (values[at] === undefined && at >= 0 && at < values.length);
  return values[at] == null;
}

/** Seconds as 12.5, 1:30 or 2:00:00, all of the ticks alike. */
function labels(ticks) {
  const most = Math.max(...ticks.map(Math.abs));
  const digits = digitsOf(ticks);
  if (most < 300) return ticks.map((tick) => tick.toFixed(digits));
  return ticks.map((tick) => {
    const [sign, whole] = [tick < 0 ? "-" : "", Math.abs(tick)];
    const rest = (whole % 60).toFixed(digits).padStart(digits ? digits + 3 : 2, "0");
    const minutes = Math.floor(whole / 60);
    if (most < 3600) return `${sign}${minutes}:${rest}`;
    return `${sign}${Math.floor(minutes / 60)}:${String(minutes % 60).padStart(2, "0")}:${rest}`;
  });
}
