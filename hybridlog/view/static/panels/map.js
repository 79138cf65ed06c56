/** The track of a satellite receiver, or of a robot, on a grid in metres: no tiles, no network. */

import { ApiError, Question, bytes, isAborted } from "../api.js";
import { element } from "../dom.js";
import { unpack } from "../packed.js";
import { plane } from "../spatial/plane.js";
import { instant } from "../state.js";
import { counted, offset } from "../words.js";
import { literal, opening } from "./python.js";
import { ofTypes } from "./types.js";

const PIXELS = 8192; // steps of time of a track
const REST = 4; // times as long as the last track took
const NEAR = 12; // pixels within which a click means the track
const accepts = ofTypes(
  "sensor_msgs/NavSatFix",
  "gps_common/GPSFix",
  "gps_msgs/GPSFix",
  "geographic_msgs/GeoPointStamped",
  "geographic_msgs/GeoPoseStamped",
  "foxglove.LocationFix",
  "foxglove_msgs/LocationFix",
  "nav_msgs/Odometry",
  "geometry_msgs/PoseStamped",
  "geometry_msgs/PoseWithCovarianceStamped",
  "geometry_msgs/Pose",
  "foxglove.PoseInFrame",
  "foxglove_msgs/PoseInFrame",
);
const FIRST = /Fix|Odometry/; // what a recording is first shown with

export default {
  kind: "map",
  title: "Map",
  isFirst: ({ type }) => FIRST.test(type),
  accepts,
  mount,
  python: (panel) =>
    [
      opening(panel),
      `frame = query.fields(${fieldsOf(panel.topic.type).map(literal).join(", ")}).to_pandas()`,
      "print(frame)",
    ].join("\n"),
};

/** Fields with the position. */
function fieldsOf(type) {
  if (/Odometry|WithCovariance/.test(type)) return ["pose.pose.position"];
  if (/PoseStamped|PoseInFrame/.test(type)) return ["pose.position"];
  return /Pose|PointStamped/.test(type) ? ["position"] : ["latitude", "longitude"];
}

function mount(body, panel) {
  const fit = element("button", { type: "button", title: "Show the whole track (0)" }, "Fit");
  const facts = element("p", { class: "facts", role: "status" }, "…");
  const problem = element("pre", { class: "problem", role: "alert", hidden: true });
  const place = element("div", { class: "space" });
  const sum = element("span", { class: "sum" });
  body.append(element("div", { class: "tools" }, sum, fit), place, problem, facts);
  body.classList.add("spatial");
  const asked = { recording: panel.recording.info.id, topic: panel.topic.topic };

  let track = null;
  let messages = -1; // of the topic when the track was asked for
  let rested = 0; // when the track may be asked for again
  let timer = 0;
  let isGone = false;
  const asking = new Question();

  const drawn = plane(place, { label: `Track of ${panel.topic.topic}`, paint, pick });
  fit.addEventListener("click", drawn.reset);
  update();
  return {
    update,
    destroy() {
      isGone = true;
      asking.stop();
      clearTimeout(timer);
      drawn.destroy();
    },
  };

  function update() {
    const { topics } = panel.recording.info;
    const now = topics.find(({ topic }) => topic === panel.topic.topic)?.messages;
    clearTimeout(timer);
    if (now !== messages && performance.now() >= rested) load(now);
    else if (now !== messages && rested < Infinity) timer = setTimeout(update, rested - performance.now());
    describe();
    drawn.redraw();
  }

  async function load(now) {
    messages = now;
    rested = Infinity;
    const begun = performance.now();
    try {
      const found = unpack(await asking.ask("track", { ...asked, pixels: PIXELS }, bytes));
      if (isGone) return;
      track = found;
      problem.hidden = true;
      place.hidden = false;
      drawn.fit(boxOf(track.arrays.xy));
      describe();
    } catch (error) {
      refuse(error);
    }
    // A track that grows is asked for again, but not all the time.
    rested = performance.now() + REST * (performance.now() - begun);
    if (!isGone) update();
  }

  /** The last position of the track at the cursor or before it; null if there is none. */
  function current() {
    const cursor = panel.cursor();
    const { times, rests, xy } = track.arrays;
    let [low, high] = [0, times.length];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (instant(times[middle]) + instant(rests[middle]) <= cursor) low = middle + 1;
      else high = middle;
    }
    if (!low || Number.isNaN(xy[2 * low - 2])) return null;
    const time = instant(times[low - 1]) + instant(rests[low - 1]);
    return { time, x: xy[2 * low - 2], y: xy[2 * low - 1] };
  }

  function paint(context, view) {
    if (!track) return;
    const { begin, end } = panel.range();
    line(context, view, track, { colour: view.theme.faint, width: 1 });
    line(context, view, track, { colour: view.theme.accent, width: 2, begin, end });
    const found = current();
    if (!found) return;
    const [right, down] = [view.x(found.x), view.y(found.y)];
    context.fillStyle = view.theme.mark;
    context.beginPath();
    context.arc(right, down, 4, 0, 2 * Math.PI);
    context.fill();
  }

  function pick(x, y, pixel) {
    if (!track) return;
    const { times, rests, xy } = track.arrays;
    let nearest = NEAR * pixel;
    let time = null;
    for (let at = 0; at < times.length; at += 1) {
      const distance = Math.hypot(xy[2 * at] - x, xy[2 * at + 1] - y);
      if (distance <= nearest) [nearest, time] = [distance, instant(times[at]) + instant(rests[at])];
    }
    if (time !== null) panel.seek(time);
  }

  function describe() {
    if (track) {
      const without = track.messages - track.fixes;
      sum.textContent = [
        track.is_geographic
          ? counted(track.fixes, "fix", "fixes")
          : counted(track.fixes, "position"),
        without ? `${counted(without, "message")} without one` : null,
        track.grid ? `grid from ${degrees(track.grid)}` : null,
      ]
        .filter(Boolean)
        .join(" · ");
      Object.assign(place.dataset, {
        points: track.arrays.times.length,
        fixes: track.fixes,
        messages: track.messages,
        exact: track.exact,
        box: JSON.stringify(boxOf(track.arrays.xy)),
      });
    }
    const found = track && current();
    facts.textContent = found ? describePlace(found) : "No position at or before the cursor.";
    facts.title = facts.textContent;
    if (found) place.dataset.at = JSON.stringify([found.x, found.y]);
    else delete place.dataset.at;
  }

  function describePlace({ time, x, y }) {
    const { grid } = track;
    if (!grid) return `${offset(time)} · x ${x.toFixed(3)} m · y ${y.toFixed(3)} m`;
    const at = { latitude: grid.latitude + y / grid.north, longitude: grid.longitude + x / grid.east };
    return `${offset(time)} · ${degrees(at)}`;
  }

  function refuse(error) {
    if (isGone || isAborted(error)) return;
    if (!(error instanceof ApiError)) throw error;
    problem.textContent = error.message;
    problem.hidden = false;
    place.hidden = true;
  }
}

/** Draws a track, or the part of it in a range; NaN is a gap. */
function line(context, view, { arrays }, { colour, width, begin, end }) {
  const { times, xy } = arrays;
  context.strokeStyle = colour;
  context.fillStyle = colour;
  context.lineWidth = width;
  context.lineJoin = "round";
  context.beginPath();
  let isDown = false;
  for (let at = 0; at < times.length; at += 1) {
    const x = xy[2 * at];
    if (Number.isNaN(x) || times[at] < begin || times[at] > end) {
      isDown = false;
      continue;
    }
    const right = view.x(x);
    const down = view.y(xy[2 * at + 1]);
    if (isDown) context.lineTo(right, down);
    else context.moveTo(right, down);
    // A single fix between gaps is a dot.
    if (!isDown) context.lineTo(right + 0.1, down);
    isDown = true;
  }
  context.lineCap = "round";
  context.stroke();
}

function boxOf(xy) {
  let [left, bottom, right, top] = [Infinity, Infinity, -Infinity, -Infinity];
  for (let at = 0; at < xy.length; at += 2) {
    if (Number.isNaN(xy[at])) continue;
    left = Math.min(left, xy[at]);
    right = Math.max(right, xy[at]);
    bottom = Math.min(bottom, xy[at + 1]);
    top = Math.max(top, xy[at + 1]);
  }
  if (left > right) return { left: -5, right: 5, bottom: -5, top: 5 };
  // A receiver that stands still is not shown in a picture of millimetres.
  const [x, y] = [(left + right) / 2, (bottom + top) / 2];
  return {
    left: Math.min(left, x - 2),
    right: Math.max(right, x + 2),
    bottom: Math.min(bottom, y - 2),
    top: Math.max(top, y + 2),
  };
}

function degrees({ latitude, longitude }) {
  const rounded = (value) => Number(Math.abs(value).toFixed(7));
  const north = `${rounded(latitude)}° ${latitude < 0 ? "S" : "N"}`;
  return `${north}, ${rounded(longitude)}° ${longitude < 0 ? "W" : "E"}`;
}
