/** The points of a laser scan or point cloud: scans from above, clouds in space. */

import { bytes } from "../api.js";
import { element, fill } from "../dom.js";
import { Colours } from "../paint.js";
import { coloursOf, onTheme, packedColours, paintScale, sameColour } from "../spatial/colours.js";
import { unpack } from "../packed.js";
import { metres, plane } from "../spatial/plane.js";
import { count, offset } from "../words.js";
import { follow } from "./follow.js";
import { moment, opening } from "./python.js";
import { ofTypes } from "./types.js";

const accepts = ofTypes(
  "sensor_msgs/LaserScan",
  "sensor_msgs/PointCloud2",
  "sensor_msgs/PointCloud",
  "foxglove.LaserScan",
  "foxglove.PointCloud",
  "foxglove_msgs/LaserScan",
  "foxglove_msgs/PointCloud",
);
const AXES = ["x", "y", "z"];
const SCANNER = { left: 0, right: 0, bottom: 0, top: 0 };
const COLOUR = "rgb";
const PLAIN = "one colour";
/** Size of a point in pixels: fewer points are larger. */
const sizeOf = (points) => (points < 2000 ? 4 : points < 20000 ? 3 : 2);

export default {
  kind: "points",
  title: "Points",
  isFirst: () => true,
  accepts,
  mount,
  python: (panel) =>
    [
      opening(panel),
      `message = query.at(${moment(panel.recording, panel.cursor())})`,
      "points = message.to_numpy()",
      "print(points.shape, points.dtype.names)",
    ].join("\n"),
};

function mount(body, panel) {
  const colour = element("select", {
    "aria-label": "Colour by",
    hidden: true,
    onchange: () => panel.setOptions({ colour: colour.value }),
  });
  const turn = element("button", {
    type: "button",
    hidden: true,
    onclick: () => panel.setOptions({ above: !isAbove() }),
  });
  const fit = element("button", { type: "button", onclick: refit, title: "Show all points (0)" }, "Fit");
  const gradient = element("canvas", { "aria-hidden": "true" });
  const [low, high] = [element("span"), element("span")];
  const legend = element("span", { class: "scale unused" }, low, gradient, high);
  const facts = element("p", { class: "facts", role: "status" }, "…");
  const problem = element("pre", { class: "problem", role: "alert", hidden: true });
  const place = element("div", { class: "space" });
  body.append(element("div", { class: "tools" }, colour, legend, turn, fit), place, problem, facts);
  body.classList.add("spatial");
  paintScale(gradient);

  let found = null; // the answer that is shown
  let usual = "intensity"; // what colours show as long as the user has not chosen
  let drawn = null; // where it is drawn: {isFlat, show, fit, reset, destroy}
  let scales = {}; // by name of the values, the least and greatest seen so far
  let box = null; // where points were seen so far, in metres of the frame
  let module = null; // draws in space; null until it is needed
  let without = ""; // why there is no space to draw in
  let isGone = false;
  let asked = chosen();

  const label = `Points of ${panel.topic.topic}`;
  const paints = new Colours(place);
  const endTheme = onTheme(() => {
    paints.forget();
    if (drawn) draw();
  });
  const following = follow({
    load,
    show: (answer) => show(answer),
    fail: (error) => refuse(error.message),
    panel,
  });
  following.want(panel.cursor());
  return {
    update() {
      if (chosen() !== asked) {
        asked = chosen();
        following.renew();
      }
      if (found && drawn && drawn.isFlat !== isFlat()) show(found);
      following.want(panel.cursor());
    },
    destroy() {
      isGone = true;
      endTheme();
      following.destroy();
      drawn?.destroy();
    },
  };

  /** What colours show: the user's choice, else what the first message suggests. */
  function chosen() {
    return typeof panel.options.colour === "string" ? panel.options.colour : null;
  }

  async function load(at, signal) {
    const parameters = { recording: panel.recording.info.id, topic: panel.topic.topic, at, seq: panel.seq() };
    const value = chosen() ?? usual;
    const isAxis = AXES.includes(value) || value === PLAIN;
    const buffer = await bytes("points", { ...parameters, value: isAxis ? null : value }, { signal });
    const answer = { ...unpack(buffer), size: buffer.byteLength, value };
    if (answer.names) usual = suggested(answer);
    // The first answer tells which values there are.
    return (chosen() ?? usual) === value ? answer : load(at, signal);
  }

  async function show(answer) {
    if (answer.time === null) return refuse("No scan or cloud at or before the cursor.", false);
    if (answer.problem) return refuse(answer.problem);
    found = answer;
    remember();
    if (!isFlat() && !module) {
      await load3d();
      if (isGone || found !== answer) return undefined;
    }
    problem.hidden = true;
    place.hidden = false;
    if (drawn?.isFlat !== isFlat()) {
      drawn?.destroy();
      drawn = null;
      drawn = made();
    }
    drawn.fit(shifted(box));
    draw();
    describe();
    return undefined;
  }

  function draw() {
    const { xyz } = found.arrays;
    drawn.show(xyz, colours(), sizeOf(xyz.length / 3));
  }

  async function load3d() {
    try {
      module = await import("../spatial/scene.js");
    } catch (error) {
      without = `${error.message}: points are shown from above.`;
    }
  }

  function made() {
    try {
      if (!isFlat()) return module.scene(place, { label, lost });
    } catch (error) {
      without = `${error.message}: points are shown from above.`;
    }
    return flat(place, label);
  }

  /** Browsers draw few scenes at a time, and take WebGL from the oldest one. */
  function lost() {
    without = "The browser draws too much with WebGL: points are shown from above.";
    show(found);
  }

  function isAbove() {
    return Boolean(panel.options.above);
  }

  function isFlat() {
    return found.flat || isAbove() || Boolean(without);
  }

  /** Widens what was seen, so that neither view nor colours jump from message to message. */
  function remember() {
    const [x, y, z] = AXES.map((axis, at) => core(axis, found.origin[at]));
    if (x) {
      const own = { left: x[0], right: x[1], bottom: y[0], top: y[1], low: z[0], high: z[1] };
      // A scan is seen from its scanner.
      if (found.flat) Object.assign(own, joined(own, { ...own, ...SCANNER }));
      box = box ? joined(box, own) : own;
    }
    const { value } = found;
    const seen = AXES.includes(value)
      ? core(value, found.origin[AXES.indexOf(value)])
      : core("value", 0);
    if (seen) {
      const scale = (scales[value] ??= { low: seen[0], high: seen[1] });
      scale.low = Math.min(scale.low, seen[0]);
      scale.high = Math.max(scale.high, seen[1]);
    }
  }

  function core(name, base) {
    const bounds = found.bounds[name];
    return bounds && [bounds[2] + base, bounds[3] + base];
  }

  /** A box of the frame in metres from the origin of this message's points. */
  function shifted(whole) {
    const [x, y, z] = found.origin;
    if (!whole) return { left: -5, right: 5, bottom: -5, top: 5, low: 0, high: 0 };
    return {
      left: whole.left - x,
      right: whole.right - x,
      bottom: whole.bottom - y,
      top: whole.top - y,
      low: whole.low - z,
      high: whole.high - z,
    };
  }

  function colours() {
    const { value, arrays, origin } = found;
    const scale = scales[value];
    if (value === COLOUR && arrays.value) return packedColours(arrays.value);
    if (AXES.includes(value) && scale) {
      const at = AXES.indexOf(value);
      const own = { low: scale.low - origin[at], high: scale.high - origin[at] };
      return coloursOf(arrays.xyz, own, 3, at);
    }
    if (arrays.value && scale) {
      return coloursOf(arrays.value, scale);
    }
    return sameColour(arrays.xyz.length / 3, paints.all().accent);
  }

  function describe() {
    const { shown, total, dropped, every, frame, time, origin, value } = found;
    const left = Object.entries(dropped).map(([why, number]) => `${count(number)} ${why}`);
    const parts = [
      shown === total ? `${count(total)} points` : `${count(shown)} of ${count(total)} points`,
      without && !found.flat ? without : null,
      ...left,
      every > 1 ? `every ${every}th is drawn` : null,
      frame ? `frame ${frame}` : null,
      origin.some(Boolean) ? `from ${origin.join(", ")} m` : null,
      offset(time),
      drawn.step ? `grid ${metres(drawn.step)}` : null,
    ];
    facts.textContent = parts.filter(Boolean).join(" · ");
    facts.title = facts.textContent;
    const options = [...found.names, ...AXES.slice(0, found.flat ? 2 : 3), PLAIN];
    if (options.join("\n") !== colour.dataset.options) {
      colour.dataset.options = options.join("\n");
      fill(colour, ...options.map((name) => element("option", { value: name }, name)));
    }
    colour.value = value;
    colour.hidden = false;
    const scale = value === COLOUR || value === PLAIN ? null : scales[value];
    legend.classList.toggle("unused", !scale);
    [low.textContent, high.textContent] = scale ? [short(scale.low), short(scale.high)] : ["", ""];
    turn.textContent = isAbove() ? "In space" : "From above";
    turn.hidden = found.flat || Boolean(without);
    Object.assign(place.dataset, {
      points: shown,
      total,
      time,
      frame,
      value,
      bounds: JSON.stringify(found.bounds),
      drawing: drawn.isFlat ? "flat" : "space",
    });
  }

  function refit() {
    box = null;
    scales = {};
    if (!found?.arrays?.xyz) return;
    show(found);
    drawn.reset();
  }

  function refuse(text, isProblem = true) {
    problem.textContent = text;
    problem.hidden = false;
    problem.classList.toggle("problem", isProblem);
    problem.classList.toggle("note", !isProblem);
    place.hidden = true;
    facts.textContent = "\u00a0";
    delete place.dataset.points;
  }
}

/** What colours show at first: the colours themselves, intensity, or else distance or height. */
function suggested({ names, flat: isFlat }) {
  const known = [COLOUR, "intensity", "range"].find((name) => names.includes(name));
  return known ?? (isFlat ? PLAIN : "z");
}

/** Points from above, on a plane. */
function flat(place, label) {
  let [xyz, colours, size] = [new Float32Array(), new Uint8Array(), 1];
  const made = plane(place, { label, paint });

  function paint(context, view) {
    let style = -1;
    for (let at = 0; at < xyz.length; at += 3) {
      const x = view.x(xyz[at]);
      const y = view.y(xyz[at + 1]);
      if (x < 0 || y < 0 || x > view.width || y > view.height) continue;
      const own = (colours[at] << 16) | (colours[at + 1] << 8) | colours[at + 2];
      if (own !== style) {
        style = own;
        context.fillStyle = `rgb(${colours[at]},${colours[at + 1]},${colours[at + 2]})`;
      }
      context.fillRect(x - size / 2, y - size / 2, size, size);
    }
  }

  return {
    ...made,
    isFlat: true,
    show(...given) {
      [xyz, colours, size] = given;
      made.redraw();
    },
  };
}

function joined(a, b) {
  const choose = { left: Math.min, right: Math.max, bottom: Math.min, top: Math.max, low: Math.min, high: Math.max };
  const ends = Object.entries(choose).map(([name, of]) => [name, of(a[name], b[name])]);
  return Object.fromEntries(ends);
}

function short(number) {
  return String(Number(number.toPrecision(4)));
}
