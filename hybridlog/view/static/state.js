/**
 * What the page shows, mirrored in the part of its address behind `#`, so that a link shows
 * the same.
 *
 * - recording: name or id; "" for the list of recordings
 * - begin, end: the visible range, ns since the start of the recording, as BigInt; null for all
 * - at: the cursor, ns since the start of the recording, as BigInt
 * - seq: of the messages at the cursor's time, the arrival number of the one that is meant, if it
 *   is a match; null for the last one
 * - panels: [{kind, topic, options}]
 * - ask: the question {kind, text, …}, or null
 */

const EMPTY = { recording: "", begin: null, end: null, at: 0n, seq: null, panels: null, ask: null };
const MAX_PANELS = 24;

let values = { ...EMPTY };
const listeners = [];

/** A time as BigInt: of a text, or the nearest one to a number, which is too coarse far from 0. */
export function instant(time) {
  return BigInt(typeof time === "number" ? Math.round(time) : time);
}

/** One value, or all of them. */
export function get(key) {
  return key === undefined ? { ...values } : values[key];
}

/**
 * Changes some values and tells who listens to them. Times may be numbers.
 *
 * @param {Object} given
 * @param {{isStep?: boolean}} [options] whether the browser's "back" returns to what was before
 */
export function set(given, { isStep = false } = {}) {
  const exact = ([key, value]) => [key, typeof value === "number" ? instant(value) : value];
  const moved = "at" in given ? { seq: null, ...given } : given;
  const changes = Object.fromEntries(Object.entries(moved).map(exact));
  const changed = Object.keys(changes).filter((key) => !isSame(values[key], changes[key]));
  if (!changed.length) return;
  values = { ...values, ...changes };
  writeAddress(isStep);
  tell(changed);
}

/** Calls back when one of some values has changed. Returns a function that ends this. */
export function on(keys, callback) {
  const listener = { keys, callback };
  listeners.push(listener);
  return () => listeners.splice(listeners.indexOf(listener), 1);
}

/** Shows another recording, or with "" the list. */
export function show(recording, others = {}) {
  set({ ...EMPTY, recording, ...others }, { isStep: true });
}

/** Reads the address, now and whenever the user changes it. */
export function start() {
  values = fromAddress();
  window.addEventListener("hashchange", () => {
    const read = fromAddress();
    const changed = Object.keys(read).filter((key) => !isSame(values[key], read[key]));
    values = read;
    tell(changed);
  });
}

/** The address of other values of the state, for links. */
export function link(changes) {
  return `#${textOf({ ...EMPTY, ...changes })}`;
}

function tell(changed) {
  for (const { keys, callback } of [...listeners]) {
    if (keys.some((key) => changed.includes(key))) callback();
  }
}

let pending = 0;

function writeAddress(isStep) {
  const write = () => {
    pending = 0;
    const text = `#${textOf(values)}`;
    if (isStep) history.pushState(null, "", text);
    else history.replaceState(null, "", text);
  };
  clearTimeout(pending);
  // Browsers limit how often an address may change, which a cursor at play does too often.
  if (isStep) write();
  else pending = setTimeout(write, 200);
}

function textOf(state) {
  const pairs = new URLSearchParams();
  if (state.recording) pairs.set("recording", state.recording);
  for (const key of ["begin", "end", "at", "seq"]) {
    if (state[key] !== EMPTY[key]) pairs.set(key, state[key]);
  }
  for (const key of ["panels", "ask"]) {
    if (state[key] !== null) pairs.set(key, JSON.stringify(state[key]));
  }
  return pairs.toString();
}

function fromAddress() {
  const pairs = new URLSearchParams(location.hash.slice(1));
  const whole = (key) => (/^-?\d{1,19}$/.test(pairs.get(key) ?? "") ? BigInt(pairs.get(key)) : null);
  const [begin, end] = [whole("begin"), whole("end")];
  const isRange = begin !== null && end !== null && begin < end;
  return {
    recording: pairs.get("recording") ?? "",
    begin: isRange ? begin : null,
    end: isRange ? end : null,
    at: whole("at") ?? 0n,
    seq: whole("seq"),
    panels: panelsFrom(parsed(pairs.get("panels"))),
    ask: questionFrom(parsed(pairs.get("ask"))),
  };
}

function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    return null;
  }
}

function panelsFrom(found) {
  if (!Array.isArray(found)) return null;
  const isPanel = (one) => typeof one?.kind === "string" && typeof one?.topic === "string";
  return found
    .filter(isPanel)
    .slice(0, MAX_PANELS)
    .map(({ kind, topic, options }) => ({ kind, topic, options: isPlain(options) ? options : {} }));
}

function questionFrom(found) {
  return isPlain(found) && typeof found.text === "string" ? found : null;
}

function isPlain(value) {
  return typeof value === "object" && value !== null && !Array.isArray(value);
}

function isSame(a, b) {
  return a === b || (a instanceof Object && JSON.stringify(a) === JSON.stringify(b));
}
