/** Paints lanes, in the colours of the page. */

const NAMES = ["ground", "raised", "text", "faint", "line", "accent", "warn", "mark", "held"];

/** The page's colours, as a canvas needs them. */
export class Colours {
  constructor(place) {
    this.probe = document.createElement("span");
    this.probe.hidden = true;
    place.append(this.probe);
    this.known = null;
  }

  /** They may be others from now on. */
  forget() {
    this.known = null;
  }

  all() {
    if (this.known === null) {
      this.known = {};
      for (const name of NAMES) {
        this.probe.style.setProperty("color", `var(--${name})`);
        this.known[name] = getComputedStyle(this.probe).color;
      }
    }
    return this.known;
  }
}

let patterns = null;

/** Patterns for gaps (thin stripes), losses (cross-hatched) and what has expired (lines). */
export function hatches(context, paints) {
  if (patterns?.paints !== paints) {
    const gap = hatch(context, 7, paints.faint, 0.45, (size) => [[size, 0]]);
    const lost = hatch(context, 6, paints.warn, 0.9, (size) => [[size, 0], [0, size]]);
    const gone = hatch(context, 4, paints.text, 0.7, (size) => [[size / 2, size / 2]]);
    patterns = { paints, gap, lost, gone };
  }
  return patterns;
}

/** A pattern of lines: each has its heights at both sides of a tile. */
function hatch(context, size, colour, alpha, lines) {
  const tile = document.createElement("canvas");
  tile.width = tile.height = size;
  const own = tile.getContext("2d");
  own.strokeStyle = colour;
  own.globalAlpha = alpha;
  own.lineWidth = 1;
  for (const by of [-size, 0, size]) {
    own.beginPath();
    for (const [left, right] of lines(size)) {
      own.moveTo(by, left);
      own.lineTo(by + size, right);
    }
    own.stroke();
  }
  return context.createPattern(tile, "repeat");
}

/**
 * Paints the messages and gaps of a topic.
 *
 * @param {Object} picture context, width, toX, begin and end
 * @param {{top: number, height: number}} box
 * @param {?import("./lanes.js").Lane} lane
 * @param {Object} paints
 * @param {{begin: number, end: number}} extent of the recording, ns
 */
export function drawLane(picture, { top, height }, lane, paints, extent) {
  if (!lane) return;
  const last = lane.begin + lane.width * lane.counts.length;
  const [begin, end] = [Math.max(picture.begin, lane.begin), Math.min(picture.end, last)];
  if (end <= begin) return;
  const { context, toX, width, ratio } = picture;
  const { counts, gaps } = lane;
  const binAt = (time) => Math.floor((time - lane.begin) / lane.width);
  const low = Math.max(binAt(begin), 0);
  const high = Math.min(binAt(end) + 1, counts.length);
  context.fillStyle = paints.gap;
  for (let n = 0; n < gaps.length; n += 2) {
    const from = Math.max(lane.begin + gaps[n] * lane.width, extent.begin, begin);
    const to = Math.min(lane.begin + gaps[n + 1] * lane.width, extent.end, end);
    if (to <= from) continue;
    const [a, b] = [Math.max(toX(from), 0), Math.min(toX(to), width)];
    if (b - a >= 1) context.fillRect(a, top, b - a, height);
  }
  let most = 1;
  for (let bin = low; bin < high; bin++) if (counts[bin] > most) most = counts[bin];
  const scale = 1 / Math.log1p(most);
  const pixel = 1 / ratio;
  context.fillStyle = paints.accent;
  context.globalAlpha = lane.exact ? 1 : 0.5;
  context.beginPath();
  let column = -1;
  let sum = 0;
  let right = 0;
  const put = () => {
    if (!sum) return;
    const size = height * (0.3 + 0.7 * Math.min(Math.log1p(sum) * scale, 1));
    context.rect(column * pixel, top + height - size, Math.max(right - column * pixel, pixel), size);
  };
  for (let bin = low; bin < high; bin++) {
    if (!counts[bin]) continue;
    const from = lane.begin + bin * lane.width;
    const next = Math.floor(toX(from) * ratio);
    if (next !== column) {
      put();
      column = next;
      sum = 0;
    }
    // Several bins in one column: the fullest one tells its height.
    sum = Math.max(sum, counts[bin]);
    right = Math.min(toX(from + lane.width), toX(end));
  }
  put();
  context.fill();
  context.globalAlpha = 1;
}
