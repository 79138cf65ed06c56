/** The ticks of a time axis, from nanoseconds to years. */

const SECOND = 1e9;
const DAY = 86400 * SECOND;
const STEPS = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, 43200];
const MAX_TICKS = 1000;

/** The step between ticks that are at least so far apart, ns. */
export function stepOf(least) {
  if (least <= SECOND / 2) return round(least);
  if (least > STEPS.at(-1) * SECOND) return round(least / DAY) * DAY;
  return STEPS.find((seconds) => seconds * SECOND >= least) * SECOND;
}

/** 1, 2 or 5 times a power of ten, at least 1 and at least so much. */
function round(least) {
  const power = 10 ** Math.floor(Math.log10(Math.max(least, 1)) + 1e-9);
  const factor = [1, 2, 5, 10].find((one) => one * power >= least * (1 - 1e-9));
  return factor * power;
}

/** Times of ticks, ns since the start: multiples of the step. */
export function ticksOf(begin, end, step) {
  const found = [];
  const first = Math.ceil(begin / step) * step;
  // Counted from the first one: far from the start, numbers are too coarse to count steps.
  for (let n = 0; first + n * step <= end && n < MAX_TICKS; n++) found.push(first + n * step);
  return found;
}

/**
 * The text of a tick: seconds, minutes or hours since the start, or a date.
 *
 * @param {number} time ns since the start
 * @param {number} step between ticks
 * @param {function(number): BigInt} toTime ns since 1970
 */
export function labelOf(time, step, toTime) {
  if (step >= DAY) {
    const date = new Date(Number(toTime(time) / 1000000n));
    return Number.isNaN(date.getTime()) ? "" : date.toISOString().slice(0, 10);
  }
  const sign = time < 0 ? "−" : "";
  const seconds = Math.abs(time) / SECOND;
  if (step < SECOND) {
    const digits = Math.min(Math.ceil(-Math.log10(step / SECOND) - 1e-9), 9);
    return `${sign}${seconds.toFixed(digits)} s`;
  }
  const whole = Math.round(seconds);
  const two = (number) => String(number).padStart(2, "0");
  const [hours, minutes] = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60];
  const rest = `${hours ? two(minutes) : minutes}:${two(whole % 60)}`;
  return sign + (hours ? `${hours}:${rest}` : rest);
}
