/** Colours for values, and turns from dark to light. */

/** Calls back when the page turns dark or light. Returns a function that ends this. */
export function onTheme(callback) {
  const scheme = matchMedia("(prefers-color-scheme: dark)");
  scheme.addEventListener("change", callback);
  return () => scheme.removeEventListener("change", callback);
}

const STEPS = 256;
const UNKNOWN = [128, 128, 128];

/** Red, green and blue of 256 steps from blue over green to red: Google's Turbo, inner part. */
const SCALE = Array.from({ length: STEPS }, (_, step) => turbo(0.08 + (0.86 * step) / (STEPS - 1)));

function turbo(x) {
  const powers = [1, x, x ** 2, x ** 3, x ** 4, x ** 5];
  const of = (factors) => factors.reduce((sum, factor, n) => sum + factor * powers[n], 0);
  return [
    of([0.13572138, 4.6153926, -42.66032258, 132.13108234, -152.94239396, 59.28637943]),
    of([0.09140261, 2.19418839, 4.84296658, -14.18503333, 4.27729857, 2.82956604]),
    of([0.1066733, 12.64194608, -60.58204836, 110.36276771, -89.90310912, 27.34824973]),
  ].map((part) => Math.round(255 * Math.min(1, Math.max(0, part))));
}

/** Paints the scale into a canvas, from the least value to the greatest. */
export function paintScale(canvas) {
  canvas.width = STEPS;
  canvas.height = 1;
  const context = canvas.getContext("2d");
  SCALE.forEach((colour, step) => {
    context.fillStyle = `rgb(${colour})`;
    context.fillRect(step, 0, 1, 1);
  });
}

/**
 * The colour of each value: red, green and blue as bytes.
 *
 * @param {Float32Array} values every `stride`-th, from `first` on
 * @param {{low: number, high: number}} scale what the ends of the scale stand for
 */
export function coloursOf(values, { low, high }, stride = 1, first = 0) {
  const made = new Uint8Array((values.length / stride) * 3);
  const factor = high > low ? (STEPS - 1) / (high - low) : 0;
  for (let from = first, to = 0; from < values.length; from += stride, to += 3) {
    const step = (values[from] - low) * factor;
    // Only NaN differs from itself.
    const colour = step !== step ? UNKNOWN : SCALE[Math.min(Math.max(step, 0), STEPS - 1) | 0];
    made[to] = colour[0];
    made[to + 1] = colour[1];
    made[to + 2] = colour[2];
  }
  return made;
}

/** The colours themselves, from numbers that hold them: red * 65536 + green * 256 + blue. */
export function packedColours(values) {
  const made = new Uint8Array(values.length * 3);
  values.forEach((value, at) => {
    made[3 * at] = (value >> 16) & 255;
    made[3 * at + 1] = (value >> 8) & 255;
    made[3 * at + 2] = value & 255;
  });
  return made;
}

/** One colour for all. */
export function sameColour(count, css) {
  const parts = css.match(/[\d.]+/g).slice(0, 3).map(Number);
  const made = new Uint8Array(count * 3);
  for (let at = 0; at < made.length; at += 3) made.set(parts, at);
  return made;
}
