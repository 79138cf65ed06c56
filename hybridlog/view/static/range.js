/** The visible range and the cursor: moved, zoomed and kept within the recording. */

import * as state from "./state.js";

const SHORTEST = 1000; // ns
const STEPS = 4096; // that numbers tell apart in the shortest range

/** The shortest range, ns: far from the start, numbers are too coarse for nanoseconds. */
function shortest({ info }) {
  const farthest = Math.max(Math.abs(info.begin), Math.abs(info.end));
  return Math.max(SHORTEST, farthest * Number.EPSILON * STEPS);
}

/** The visible range, ns since the start. */
export function visible(recording) {
  const { info } = recording;
  const begin = state.get("begin") ?? info.begin;
  const end = state.get("end") ?? info.end;
  return { begin, end: Math.max(end, begin + shortest(recording)) };
}

/** Shows a range, or as much of it as the recording has. */
export function show(recording, begin, end) {
  const { info } = recording;
  const least = shortest(recording);
  const whole = Math.max(info.end - info.begin, least);
  const span = Math.min(Math.max(end - begin, least), whole);
  if (span >= whole) return state.set({ begin: null, end: null });
  const low = Math.min(Math.max(begin, info.begin), info.end - span);
  state.set({ begin: Math.round(low), end: Math.round(low + span) });
}

/** Makes the range shorter or longer by a factor, around a time that stays where it is. */
export function zoom(recording, factor, around) {
  const { begin, end } = visible(recording);
  const span = Math.max((end - begin) * factor, shortest(recording));
  const share = (Math.min(Math.max(around, begin), end) - begin) / (end - begin);
  show(recording, around - share * span, around + (1 - share) * span);
}

/** Moves the range by a share of its length. */
export function pan(recording, share) {
  const { begin, end } = visible(recording);
  const by = share * (end - begin);
  show(recording, begin + by, end + by);
}

/** The last time at which the cursor can be, ns since the start. */
export function lastTime({ info }) {
  return Math.max(info.end - 1, info.begin);
}

/** Moves the cursor; the range follows when it would be out of sight. */
export function seek(recording, time) {
  const at = Math.round(Math.min(Math.max(time, recording.info.begin), lastTime(recording)));
  state.set({ at });
  const { begin, end } = visible(recording);
  if (at < begin) show(recording, at - (end - begin) * 0.9, at + (end - begin) * 0.1);
  else if (at >= end) show(recording, at - (end - begin) * 0.1, at + (end - begin) * 0.9);
}
