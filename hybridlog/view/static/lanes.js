/** Asks the server for messages by pixel, and keeps what is needed to draw them at any zoom. */

import { ApiError, bytes } from "./api.js";
import { notice } from "./dom.js";
import { unpack } from "./packed.js";
import { clamped } from "./range.js";
import { instant } from "./state.js";

const MAX_LANES = 64;
const MAX_PIXELS = 8192;
const MAX_BINS = 1 << 17;
const LATEST = 2n ** 63n - 1n; // ns

/**
 * Messages of one topic by bin.
 *
 * @typedef {Object} Lane
 * @property {number} begin of the first bin, ns since the start
 * @property {number} width of a bin, ns
 * @property {ArrayLike<number>} counts
 * @property {boolean} exact false if they are estimates
 * @property {number} period the usual time from one message to the next, ns; 0 if unknown
 * @property {ArrayLike<number>} gaps pairs: first bin, and the one behind the last
 */

/** Lanes and the start of the recording, from the answer of `timeline`. */
export function decoded(buffer, topics) {
  const { start, begin, width, lanes, arrays } = unpack(buffer);
  const found = lanes.map(({ exact, period }, place) => {
    const [counts, gaps] = [arrays[`counts ${place}`], arrays[`gaps ${place}`]];
    return [topics[place], { begin, width, counts, exact, period, gaps }];
  });
  return { start: BigInt(start), lanes: new Map(found) };
}

/** The number of messages of a lane between two times. Bins that are cut count as a whole. */
export function countBetween(lane, begin, end) {
  const low = Math.max(Math.floor((begin - lane.begin) / lane.width), 0);
  const high = Math.min(Math.ceil((end - lane.begin) / lane.width), lane.counts.length);
  let sum = 0;
  for (let bin = low; bin < high; bin++) sum += lane.counts[bin];
  return sum;
}

/**
 * The lanes of a recording.
 *
 * @param {import("./recording.js").Recording} recording
 * @param {function()} onChange called when there is more to draw
 */
export class Lanes {
  constructor(recording, onChange) {
    this.recording = recording;
    this.onChange = onChange;
    this.known = new Map();
    this.wanted = null;
    this.isAsking = false;
    this.stop = new AbortController();
  }

  /** The lane of a topic, as far as it is there. */
  of(topic) {
    return this.known.get(topic);
  }

  /** Asks for what a picture needs and is not there; `isNew` asks for it in any case. */
  want(begin, end, pixels, topics, isNew = false) {
    const { info } = this.recording;
    // A range may be longer than the recording, outside of which there is nothing to ask for.
    const [low, high] = [Math.max(begin, Number(info.begin)), Math.min(end, Number(info.end))];
    const isThere = (topic) => {
      const lane = this.known.get(topic);
      if (!lane) return false;
      const last = lane.begin + lane.width * lane.counts.length;
      const isFine = lane.width <= Math.max(widthOf(end - begin, pixels), 1);
      return isFine && lane.begin <= low && last >= high;
    };
    const lacking = isNew ? topics : topics.filter((topic) => !isThere(topic));
    this.wanted = lacking.length ? { begin, end, pixels, topics: lacking } : null;
    if (this.wanted && !this.isAsking) this.ask();
  }

  async ask() {
    this.isAsking = true;
    try {
      while (this.wanted && !this.stop.signal.aborted) {
        const wanted = this.wanted;
        this.wanted = null;
        await this.fetch(wanted);
      }
    } catch (error) {
      if (error instanceof ApiError) notice(error.message);
      else if (error.name !== "AbortError") throw error;
    } finally {
      this.isAsking = false;
    }
  }

  async fetch({ begin, end, pixels, topics }) {
    const asked = topics.slice(0, MAX_LANES);
    // As much again at both sides, so that moving the picture shows something at once.
    const { info } = this.recording;
    const margin = (end - begin) / 2;
    const isWhole = begin <= Number(info.begin) && end >= Number(info.end);
    const [low, high] = isWhole
      ? [info.begin, info.end > info.begin ? info.end : info.begin + 1n]
      : [begin - margin, end + margin].map((time) => clamped(instant(time), -LATEST, LATEST));
    const most = Math.min(MAX_PIXELS, Math.floor(MAX_BINS / asked.length));
    const answer = await bytes(
      "timeline",
      {
        recording: info.id,
        begin: low,
        end: high,
        pixels: Math.max(Math.min(isWhole ? pixels : 2 * pixels, most), 1),
        topic: asked,
      },
      { signal: this.stop.signal },
    );
    const { start, lanes } = decoded(answer, asked);
    if (start !== this.recording.start) return; // of before the recording was known to begin earlier
    for (const [topic, lane] of lanes) this.known.set(topic, lane);
    this.onChange();
  }

  destroy() {
    this.stop.abort();
  }
}

/** The width of bins that the server makes for a picture, ns. */
function widthOf(span, pixels) {
  return 2 ** Math.ceil(Math.log2(Math.max(span / pixels, 1)));
}
