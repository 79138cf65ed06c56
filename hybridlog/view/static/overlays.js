/**
 * What other parts of the page draw over the timeline: ticks and bands, by the name of who
 * draws them.
 *
 * @typedef {Object} Overlay
 * @property {string} title what it shows, for people
 * @property {?string} lane the topic whose lane it is drawn on; null for all
 * @property {Array<[number, number]>} ticks time and count, ns since the start, in order
 * @property {Array<[number, number]>} bands begin and end, ns since the start, in order
 */

const drawn = new Map();
const listeners = new Set();

/** Draws something over the timeline; null takes it away. */
export function draw(name, overlay) {
  if (overlay === null) drawn.delete(name);
  else drawn.set(name, overlay);
  for (const callback of listeners) callback();
}

/** All that is drawn over the timeline. */
export function all() {
  return [...drawn.values()];
}

/** Calls back when this has changed. Returns a function that ends it. */
export function on(callback) {
  listeners.add(callback);
  return () => listeners.delete(callback);
}
