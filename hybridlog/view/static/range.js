/** The visible range and the cursor: moved, zoomed and kept within the recording. */

import * as state from "./state.js";

const SHORTEST = 1000; // ns
const STEPS = 4096; // that numbers tell apart in the shortest range

/** The shortest range, ns: far from the start, numbers are too coarse for nanoseconds. */
function shortest({ info }) {
  const farthest = Math.max(Math.abs(Number(info.begin)), Math.abs(Number(info.end)));
  return Math.max(SHORTEST, farthest * Number.EPSILON * STEPS);
}

/** A value, or the bound that it is beyond. */
export function clamped(value, low, high) {
  return value < low ? low : value > high ? high : value;
}

/** The visible range as it is asked for, ns since the start, as BigInt. */
export function exactRange(recording) {
  const { info } = recording;
  const begin = state.get("begin") ?? info.begin;
  const end = state.get("end") ?? info.end;
  const least = begin + state.instant(shortest(recording));
  return { begin, end: end < least ? least : end };
}

/** The visible range as it is drawn, ns since the start, as numbers. */
export function visible(recording) {
  const { begin, end } = exactRange(recording);
  return { begin: Number(begin), end: Number(end) };
}

/** Shows a range, or as much of it as the recording has. */
export function show(recording, begin, end) {
  const { info } = recording;
  const least = state.instant(shortest(recording));
  const all = info.end - info.begin;
  const whole = all < least ? least : all;
  const span = clamped(state.instant(end) - state.instant(begin), least, whole);
  if (span >= whole) return state.set({ begin: null, end: null });
  const low = clamped(state.instant(begin), info.begin, info.end - span);
  state.set({ begin: low, end: low + span });
}

/** Makes the range shorter or longer by a factor, around a time that stays where it is. */
export function zoom(recording, factor, around) {
  const { begin, end } = visible(recording);
  const span = Math.max((end - begin) * factor, shortest(recording));
  const at = clamped(Number(around), begin, end);
  const share = (at - begin) / (end - begin);
  show(recording, at - share * span, at + (1 - share) * span);
}

/** Moves the range by a share of its length. */
export function pan(recording, share) {
  const { begin, end } = visible(recording);
  const by = share * (end - begin);
  show(recording, begin + by, end + by);
}

/** The last time at which the cursor can be, ns since the start, as BigInt. */
export function lastTime({ info }) {
  return info.end > info.begin ? info.end - 1n : info.begin;
}

/** Moves the cursor, to a match by its arrival number; the range follows when it is out of sight. */
export function seek(recording, time, seq = null) {
  const at = clamped(state.instant(time), recording.info.begin, lastTime(recording));
  state.set({ at, seq });
  const { begin, end } = exactRange(recording);
  const [now, span] = [Number(at), Number(end - begin)];
  if (at < begin) show(recording, now - span * 0.9, now + span * 0.1);
  else if (at >= end) show(recording, now - span * 0.1, now + span * 0.9);
}
