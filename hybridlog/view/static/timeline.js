/** The timeline: a lane a topic with its messages by pixel, gaps, losses, marks and matches. */

import { labelOf, stepOf, ticksOf } from "./axis.js";
import { element, fill } from "./dom.js";
import { countBetween, Lanes } from "./lanes.js";
import * as overlays from "./overlays.js";
import { drawLane, hatches, Colours } from "./paint.js";
import { openPanel } from "./panels.js";
import { mountPlayer } from "./player.js";
import { seek, show, visible, zoom } from "./range.js";
import * as state from "./state.js";
import { count, counted, duration, moment, offset } from "./words.js";
import { groupOf, shortType } from "./panels/types.js";

const AXIS = 30;
const MAX_SHOWN = 12; // lanes that are seen without scrolling
const NARROW = matchMedia("(max-width: 40rem)");
const DARK = matchMedia("(prefers-color-scheme: dark)");
const CLICK = 4; // pixels that a click may move

/** Adds the timeline of a recording to an element. Returns a function that takes it away. */
export function mountTimeline(parent, recording) {
  let topics = [];
  let marks = [];
  let frame = 0;
  let hover = null; // {x, y, lane}
  let selected = null; // {from, to}, ns
  const pointers = new Map();
  let moved = 0;

  const axis = element("canvas", { class: "axis", "aria-hidden": "true" });
  const canvas = element("canvas", { class: "density", tabindex: "0", role: "slider" });
  canvas.setAttribute("aria-label", "Cursor in the timeline");
  const names = element("div", { class: "names" });
  const filtered = { "aria-label": "Filter of the lanes", oninput: () => recorded() };
  const filter = element("input", { type: "search", ...filtered });
  const corner = element("div", { class: "corner" }, filter);
  const scroller = element("div", { class: "lanes" }, names, canvas);
  const tip = element("div", { class: "tip", hidden: true, role: "status" });
  const section = element("section", { class: "timeline", "aria-label": "Timeline" });
  const ends = [mountPlayer(section, recording)];
  section.append(corner, axis, scroller, tip);
  parent.append(section);

  const lanes = new Lanes(recording, schedule);
  const colours = new Colours(section);
  const sizes = new ResizeObserver(schedule);
  sizes.observe(scroller);
  sizes.observe(axis);

  const listen = (target, name, heard, options) => {
    target.addEventListener(name, heard, options);
    ends.push(() => target.removeEventListener(name, heard, options));
  };
  for (const one of [canvas, axis]) {
    listen(one, "wheel", wheel, { passive: false });
    listen(one, "pointerdown", press);
    listen(one, "pointermove", move);
    listen(one, "pointerup", release);
    listen(one, "pointercancel", cancel);
    listen(one, "pointerleave", leave);
  }
  listen(scroller, "scroll", schedule);
  listen(names, "keydown", step);
  listen(NARROW, "change", () => recorded());
  listen(DARK, "change", () => {
    colours.forget();
    schedule();
  });
  ends.push(
    state.on(["begin", "end", "at"], schedule),
    overlays.on(schedule),
    recording.on(() => recorded(true)),
  );
  recorded();
  return () => {
    cancelAnimationFrame(frame);
    ends.forEach((end) => end());
    sizes.disconnect();
    lanes.destroy();
    section.remove();
  };

  /** Takes over what is known of the recording, and what has come since. */
  function recorded(isNew = false) {
    const words = filter.value.toLowerCase().split(/\s+/);
    const isIn = ({ topic, type }) => (word) => `${topic} ${type}`.toLowerCase().includes(word);
    topics = recording.info.topics.filter((one) => words.every(isIn(one))).sort(byGroup);
    filter.placeholder = counted(recording.info.topics.length, "topic");
    const height = rowHeight();
    for (const one of [scroller, canvas]) {
      one.style.setProperty("height", `${Math.min(topics.length, MAX_SHOWN) * height}px`);
    }
    names.style.setProperty("height", `${topics.length * height}px`);
    marks = recording.info.marks;
    if (isNew) lanes.want(...wanted(), true);
    schedule();
  }

  function rowHeight() {
    return NARROW.matches ? 34 : 22;
  }

  /** The topics that can be seen. */
  function seen() {
    const height = rowHeight();
    const first = Math.floor(scroller.scrollTop / height);
    const last = Math.ceil((scroller.scrollTop + scroller.clientHeight) / height);
    return { first, topics: topics.slice(first, last) };
  }

  function wanted() {
    const { begin, end } = visible(recording);
    const pixels = Math.ceil(canvas.clientWidth * devicePixelRatio) || 1;
    return [begin, end, pixels, seen().topics.map(({ topic }) => topic)];
  }

  // Drawing.

  function schedule() {
    if (!frame) frame = requestAnimationFrame(draw);
  }

  function draw() {
    frame = 0;
    if (!canvas.clientWidth || !axis.clientWidth) return;
    lanes.want(...wanted());
    drawNames();
    drawLanes();
    drawAxis();
    drawTip();
    const at = state.get("at");
    canvas.setAttribute("aria-valuemin", Number(recording.info.begin) / 1e9);
    canvas.setAttribute("aria-valuemax", Number(recording.info.end) / 1e9);
    canvas.setAttribute("aria-valuenow", Number(at) / 1e9);
    canvas.setAttribute("aria-valuetext", offset(at));
  }

  function drawNames() {
    const height = rowHeight();
    const { first, topics: shown } = seen();
    const drawn = JSON.stringify([height, first, shown.map(({ topic, messages }) => [topic, messages])]);
    if (drawn === names.dataset.drawn) return; // so that a name keeps the focus
    names.dataset.drawn = drawn;
    const focused = names.contains(document.activeElement) ? document.activeElement.textContent : null;
    fill(
      names,
      ...shown.map(({ topic, type, messages }, place) => {
        const said = `${topic}, ${type || "unknown type"}, ${counted(messages, "message")}`;
        const open = () => openPanel(recording, topic);
        const name = { type: "button", class: "plain topic", title: said, onclick: open };
        const row = element(
          "div",
          { class: "name" },
          element("button", name, topic),
          element("span", { class: "type" }, shortType(type)),
          element("span", { class: "number" }, count(messages)),
        );
        row.style.setProperty("top", `${(first + place) * height}px`);
        row.style.setProperty("height", `${height}px`);
        return row;
      }),
    );
    if (focused !== null) focusName(focused);
  }

  function focusName(topic) {
    const found = [...names.querySelectorAll(".topic")].find((one) => one.textContent === topic);
    found?.focus({ preventScroll: true });
  }

  /** Moves from one name to the next one, which may be out of sight. */
  function step(event) {
    const by = { ArrowUp: -1, ArrowDown: 1 }[event.key];
    const from = topics.findIndex(({ topic }) => topic === document.activeElement.textContent);
    const next = topics[from + by];
    if (!by || from < 0 || !next) return;
    event.preventDefault();
    const [top, height] = [(from + by) * rowHeight(), rowHeight()];
    if (top < scroller.scrollTop) scroller.scrollTop = top;
    const below = top + height - scroller.scrollTop - scroller.clientHeight;
    if (below > 0) scroller.scrollTop += below;
    drawNames();
    focusName(next.topic);
  }

  /** A canvas in pixels of the device, its context, and a function from times to pixels. */
  function prepared(of) {
    const ratio = devicePixelRatio;
    const [width, height] = [of.clientWidth, of.clientHeight];
    const [wide, high] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (of.width !== wide || of.height !== high) [of.width, of.height] = [wide, high];
    const context = of.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const { begin, end } = visible(recording);
    const toX = (time) => ((time - begin) / (end - begin)) * width;
    return { context, width, height, toX, begin, end, ratio };
  }

  function drawLanes() {
    const picture = prepared(canvas);
    const { context, width, height, toX } = picture;
    const paints = { ...colours.all(), ...hatches(context, colours.all()) };
    const extent = { begin: Number(recording.info.begin), end: Number(recording.info.end) };
    const row = rowHeight();
    const inset = NARROW.matches ? 14 : 3;
    const { first, topics: shown } = seen();
    drawBands(picture, paints);
    shown.forEach(({ topic, messages }, place) => {
      const top = (first + place) * row - scroller.scrollTop;
      const box = { top: top + inset, height: row - inset - 2 };
      context.fillStyle = paints.line;
      context.fillRect(0, top + row - 1, width, 1);
      if (messages) drawLane(picture, box, lanes.of(topic), paints, extent);
      for (const loss of recording.info.losses) {
        if (loss.begin === null || loss.count === 0 || (loss.topic ?? topic) !== topic) continue;
        drawLoss(picture, { top, height: row - 1 }, loss, paints);
      }
      context.fillStyle = paints.gone;
      for (const { begin, end } of recording.info.gone.filter((one) => one.topic === topic)) {
        context.fillRect(toX(begin), top, Math.max(toX(end) - toX(begin), 3), row - 1);
      }
      context.fillStyle = paints.warn;
      for (const { ticks } of overlays.all().filter(({ lane }) => lane === topic)) {
        for (const [time] of ticks) context.fillRect(Math.round(toX(time)) - 1, top + 1, 3, row - 3);
      }
    });
    context.strokeStyle = paints.mark;
    context.setLineDash([4, 3]);
    for (const time of marks.flatMap(({ at, end }) => [at, end])) line(context, toX(time), 0, height);
    context.setLineDash([]);
    drawCursor(picture, paints);
  }

  /** Bands with edges, for what holds for a while. */
  function drawBands({ context, width, height, toX }, paints) {
    for (const [begin, end] of overlays.all().flatMap(({ bands }) => bands)) {
      const [low, high] = [Math.max(toX(begin), -2), Math.min(toX(end), width + 2)];
      if (high < 0 || low > width) continue;
      context.fillStyle = paints.held;
      context.fillRect(low, 0, Math.max(high - low, 1), height);
      context.fillStyle = paints.faint;
      context.fillRect(low, 0, 1, height);
      context.fillRect(Math.max(high - 1, low), 0, 1, height);
    }
  }

  function drawLoss({ context, width, toX }, { top, height }, { begin, end }, paints) {
    const low = Math.max(toX(begin), -2);
    const high = Math.min(Math.max(toX(end), toX(begin) + 3), width + 2);
    if (high < 0 || low > width) return;
    context.fillStyle = paints.lost;
    context.fillRect(low, top, high - low, height);
    context.strokeStyle = paints.warn;
    context.strokeRect(low + 0.5, top + 0.5, Math.max(high - low - 1, 1), height - 1);
  }

  function drawCursor({ context, width, height, toX }, paints) {
    if (selected) {
      const [low, high] = [toX(selected.from), toX(selected.to)].sort((a, b) => a - b);
      context.fillStyle = paints.held;
      context.fillRect(low, 0, high - low, height);
    }
    const x = toX(Number(state.get("at")));
    if (x < -1 || x > width + 1) return;
    context.fillStyle = paints.text;
    context.fillRect(Math.round(x) - 0.75, 0, 1.5, height);
  }

  function drawAxis() {
    const picture = prepared(axis);
    const { context, width, toX, begin, end } = picture;
    const paints = colours.all();
    const step = stepOf(((end - begin) / width) * 84);
    context.font = "11px system-ui, 'DejaVu Sans', sans-serif";
    context.textBaseline = "top";
    for (const time of ticksOf(begin, end, step)) {
      const x = Math.round(toX(time));
      context.fillStyle = paints.line;
      context.fillRect(x, 0, 1, AXIS);
      context.fillStyle = paints.faint;
      const label = labelOf(time, step, recording.toTime);
      if (x + 4 + context.measureText(label).width <= width) context.fillText(label, x + 4, 2);
    }
    context.fillStyle = paints.mark;
    for (const mark of marks) {
      flag(context, toX(mark.at));
      context.fillRect(toX(mark.at), AXIS - 3, toX(mark.end) - toX(mark.at), 3);
      if (mark.end > mark.at) context.fillRect(toX(mark.end) - 1, AXIS - 8, 2, 8);
    }
    context.fillStyle = paints.text;
    for (const { ticks } of overlays.all().filter(({ lane }) => !lane)) {
      for (const [time] of ticks) context.fillRect(Math.round(toX(time)) - 0.5, AXIS - 6, 1.5, 6);
    }
    context.fillStyle = paints.warn;
    for (const loss of recording.info.losses) {
      if (loss.begin === null || loss.count === 0) continue;
      context.fillRect(toX(loss.begin), AXIS - 3, Math.max(toX(loss.end) - toX(loss.begin), 3), 3);
    }
    drawCursor(picture, paints);
    const x = toX(Number(state.get("at")));
    context.beginPath();
    context.moveTo(x - 5, AXIS - 9);
    context.lineTo(x + 5, AXIS - 9);
    context.lineTo(x, AXIS);
    context.fill();
  }

  // The text at the pointer.

  function drawTip() {
    tip.hidden = !hover || pointers.size > 0;
    if (tip.hidden) return;
    const { begin, end } = visible(recording);
    const nsPerPixel = (end - begin) / canvas.clientWidth;
    const time = begin + hover.x * nsPerPixel;
    const lines = [`${offset(state.instant(time), digitsOf(nsPerPixel))}  ${moment(recording.toTime(time))}`];
    if (hover.lane !== null) lines.push(...aboutLane(topics[hover.lane].topic, time, nsPerPixel));
    const near = 4 * nsPerPixel;
    const here = marks.filter((mark) => mark.at - near < time && time < mark.end + near);
    lines.push(...here.slice(0, 5).map(({ text }) => `Mark: ${text}`));
    for (const { title, lane, bands, ticks } of overlays.all()) {
      if (lane && lane !== topics[hover.lane]?.topic) continue;
      const isIn = bands.some(([low, high]) => low <= time && time < high);
      const close = ticks.filter(([at]) => Math.abs(at - time) < near);
      const matches = close.reduce((sum, [, number]) => sum + number, 0);
      if (matches) lines.push(`${title}: ${count(matches)} here`);
      else if (isIn) lines.push(title);
    }
    fill(tip, ...lines.map((text) => element("div", {}, text)));
    const box = section.getBoundingClientRect();
    const from = canvas.getBoundingClientRect();
    const left = Math.min(from.left - box.left + hover.x + 14, box.width - tip.offsetWidth - 4);
    tip.style.setProperty("left", `${Math.max(left, 4)}px`);
    tip.style.setProperty("top", `${hover.top - box.top + 18}px`);
  }

  function aboutLane(topic, time, nsPerPixel) {
    const lines = [topic];
    const lane = lanes.of(topic);
    if (lane) {
      const bin = Math.floor((time - lane.begin) / lane.width);
      const begin = lane.begin + bin * lane.width;
      const last = Math.max(begin + lane.width, begin + nsPerPixel);
      const messages = countBetween(lane, begin, last);
      const about = lane.exact ? "" : "about ";
      const noun = messages === 1 ? "message" : "messages";
      lines.push(`${about}${count(messages)} ${noun} in ${duration(Math.max(lane.width, 1))}`);
      for (let n = 0; n < lane.gaps.length; n += 2) {
        if (bin < lane.gaps[n] || bin >= lane.gaps[n + 1]) continue;
        const length = (lane.gaps[n + 1] - lane.gaps[n]) * lane.width;
        lines.push(`Gap of ${duration(length)} or more; usually every ${duration(lane.period)}`);
      }
    }
    for (const loss of recording.info.losses) {
      if (loss.begin === null || loss.count === 0 || (loss.topic ?? topic) !== topic) continue;
      if (time < loss.begin - 3 * nsPerPixel || time > loss.end + 3 * nsPerPixel) continue;
      const lost = loss.count === null ? "Messages" : count(loss.count);
      lines.push(`${lost} lost (${loss.cause}${loss.reason ? `: ${loss.reason}` : ""})`);
    }
    for (const { cause, begin, end, topic: own } of recording.info.gone) {
      if (own !== topic || time < begin || time > end) continue;
      const where = cause === "expired" ? "have expired" : "are elsewhere";
      lines.push(`Payloads ${where}: only fields are here`);
    }
    return lines;
  }

  // Pointers.

  function timeAt(x) {
    const { begin, end } = visible(recording);
    return begin + (x / canvas.clientWidth) * (end - begin);
  }

  function place(event) {
    const box = event.currentTarget.getBoundingClientRect();
    return { x: event.clientX - box.left, y: event.clientY - box.top };
  }

  function wheel(event) {
    event.preventDefault();
    const { x } = place(event);
    const scale = event.deltaMode === 1 ? 16 : 1;
    const [dx, dy] = [event.deltaX * scale, event.deltaY * scale];
    if (event.shiftKey && !event.ctrlKey) scroller.scrollTop += dy || dx;
    else if (Math.abs(dx) > Math.abs(dy)) slide(-dx);
    else {
      const by = Math.min(Math.max(dy, -1000), 1000) * (event.ctrlKey ? 0.01 : 0.003);
      zoom(recording, Math.exp(by), timeAt(x));
    }
  }

  function slide(pixels) {
    const { begin, end } = visible(recording);
    const by = (pixels / canvas.clientWidth) * (end - begin);
    show(recording, begin - by, end - by);
  }

  function press(event) {
    if (event.button !== 0) return;
    event.currentTarget.setPointerCapture(event.pointerId);
    const at = place(event);
    pointers.set(event.pointerId, at);
    moved = pointers.size > 1 ? Infinity : 0;
    selected = event.shiftKey ? { from: timeAt(at.x), to: timeAt(at.x) } : null;
  }

  function move(event) {
    const at = place(event);
    const before = pointers.get(event.pointerId);
    const row = rowHeight();
    const lane = event.currentTarget === canvas ? Math.floor((at.y + scroller.scrollTop) / row) : null;
    // Half a pixel above the first lane is still on its canvas.
    const isLane = lane !== null && lane >= 0 && lane < topics.length;
    hover = { ...at, top: event.clientY, lane: isLane ? lane : null };
    if (!before) return schedule();
    moved += Math.abs(at.x - before.x) + Math.abs(at.y - before.y);
    if (selected) selected.to = timeAt(at.x);
    else if (pointers.size === 2) pinch(event.pointerId, before, at);
    else if (moved > CLICK) {
      slide(at.x - before.x);
      scroller.scrollTop -= at.y - before.y;
    }
    pointers.set(event.pointerId, at);
    schedule();
  }

  function pinch(id, before, at) {
    const [other] = [...pointers].filter(([one]) => one !== id).map(([, there]) => there);
    const [was, is] = [Math.abs(before.x - other.x), Math.abs(at.x - other.x)];
    if (was > 8 && is > 8) zoom(recording, was / is, timeAt((at.x + other.x) / 2));
    slide((at.x - before.x) / 2);
  }

  function release(event) {
    if (!pointers.delete(event.pointerId)) return;
    if (selected && moved > CLICK) {
      const [low, high] = [selected.from, selected.to].sort((a, b) => a - b);
      show(recording, low, high);
    } else if (moved <= CLICK) {
      seek(recording, timeAt(place(event).x));
      canvas.focus({ preventScroll: true });
    }
    selected = null;
    schedule();
  }

  function cancel(event) {
    pointers.delete(event.pointerId);
    selected = null;
    schedule();
  }

  function leave() {
    hover = null;
    schedule();
  }
}

function byGroup(a, b) {
  const order = groupOf(a.type) - groupOf(b.type);
  return order || (a.topic < b.topic ? -1 : 1);
}

function line(context, x, top, bottom) {
  context.beginPath();
  context.moveTo(x, top);
  context.lineTo(x, bottom);
  context.stroke();
}

function flag(context, x) {
  context.fillRect(x - 0.75, 14, 1.5, AXIS - 14);
  context.beginPath();
  context.moveTo(x, 14);
  context.lineTo(x + 9, 18);
  context.lineTo(x, 22);
  context.fill();
}

/** Digits behind the point that tell pixels apart. */
function digitsOf(nsPerPixel) {
  return Math.min(Math.max(Math.ceil(-Math.log10(nsPerPixel / 1e9)), 0), 9);
}
