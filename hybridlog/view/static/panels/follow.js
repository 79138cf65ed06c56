/** Keeps what a panel shows current at the cursor, without a queue of requests. */

import { ApiError } from "../api.js";
import { instant } from "../state.js";

const MAX_KEPT = 64;
const MAX_BYTES = 64 << 20;
const STILL_PLAYING = 160; // ms between two steps of a cursor that plays

/**
 * An answer about one message.
 *
 * @typedef {Object} Answer
 * @property {?BigInt} time log time of the message, ns since the start; null without one
 * @property {?BigInt} until log time of the next message; null if no later one is known
 * @property {number} [size] bytes
 */

/**
 * Asks for one message at a time. While an answer is under way only the newest cursor is
 * remembered, so messages are left out rather than shown late. While the cursor plays, it asks
 * for the time at which the answer will have come.
 *
 * @param {Object} parts
 * @param {function(BigInt, AbortSignal): Promise<Answer>} parts.load asks for the message at a
 *     time; its times are texts still
 * @param {function(Answer)} parts.show shows one
 * @param {function(Error)} parts.fail shows why there is none
 * @param {import("../panels.js").Panel} parts.panel
 */
export function follow({ load, show, fail, panel }) {
  const { recording } = panel;
  let kept = [];
  let { start } = recording; // what the times of these count from
  let shown = null;
  let wanted = null;
  let last = { at: 0n, when: -Infinity };
  let speed = 0; // ns of the recording for each ms; 0 when it does not play
  let latency = 30; // ms
  let isRunning = false;
  let isGone = false;
  const stopped = new AbortController();
  let stopping = 0;

  const covers = ({ time, until, of }, at) =>
    of === panel.seq() && (time ?? -Infinity) <= at && at < (until ?? Infinity);

  function take(answer) {
    if (answer === shown) return;
    shown = answer;
    show(answer);
  }

  /** Shows what is current at the wanted time, as far as it is there already. */
  function choose() {
    const exact = kept.find((answer) => covers(answer, wanted));
    if (exact) return take(exact);
    if (!speed) return undefined;
    const passed = kept.filter(({ time }) => time !== null && time <= wanted);
    const newest = passed.reduce((a, b) => (a && a.time >= b.time ? a : b), null);
    if (newest && newest.time > (shown?.time ?? -Infinity)) take(newest);
    return undefined;
  }

  function keep(answer) {
    kept = [answer, ...kept].slice(0, MAX_KEPT);
    let bytes = 0;
    kept = kept.filter(({ size }, place) => (bytes += size ?? 0) <= MAX_BYTES || !place);
  }

  function received(answer, at) {
    // Of a recording that goes on, later messages may come.
    if (answer.until === null && recording.info.status === "open") answer.until = at + 1n;
    keep(answer);
    const isEarly = speed && answer.time > wanted;
    if (covers(answer, wanted) || !isEarly) take(answer);
  }

  async function ask() {
    if (isRunning || isGone) return;
    const at = wanted + instant(speed * latency);
    if (kept.some((answer) => covers(answer, at))) return;
    isRunning = true;
    const begun = performance.now();
    const of = panel.seq();
    try {
      const answer = Object.assign(await load(at, stopped.signal), { of });
      if (isGone) return;
      for (const name of ["time", "until"]) answer[name] &&= instant(answer[name]);
      if (recording.start === start) received(answer, at);
      latency += (performance.now() - begun - latency) / 4;
    } catch (error) {
      if (isGone) return;
      if (!(error instanceof ApiError)) throw error;
      shown = null;
      fail(error);
      if (wanted === at) return; // not again before the cursor moves
    } finally {
      isRunning = false;
    }
    ask();
  }

  /** The cursor stays where it is: what is shown must be exact now. */
  function stop() {
    speed = 0;
    choose();
    ask();
  }

  return {
    /** Shows the message that is current at a time. */
    want(at) {
      if (recording.start !== start) [start, kept, shown] = [recording.start, [], null];
      const when = performance.now();
      const step = Number(at - last.at);
      const isPlaying = step > 0 && when - last.when < STILL_PLAYING;
      if (at !== last.at) {
        speed = isPlaying ? step / Math.max(when - last.when, 1) : 0;
        last = { at, when };
      }
      wanted = at;
      choose();
      ask();
      clearTimeout(stopping);
      if (speed) stopping = setTimeout(stop, STILL_PLAYING);
    },
    /** Forgets all answers, and asks again. */
    renew() {
      kept = [];
      shown = null;
      if (wanted !== null) ask();
    },
    destroy() {
      isGone = true;
      stopped.abort();
      clearTimeout(stopping);
      kept = [];
    },
  };
}
