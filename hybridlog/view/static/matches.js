/** The matches of the question in the visible range: asked anew when that changes, and drawn. */

import { ApiError, get, isAborted } from "./api.js";
import * as state from "./state.js";

/**
 * @typedef {Object} Matches
 * @property {string} topic
 * @property {number} begin time of the first pixel, ns since the start of the recording
 * @property {number} width time of a pixel, ns
 * @property {number[]} pixels numbers of pixels with matches
 * @property {number[]} counts matches in each of them
 * @property {number[]} first time of the first match in each of them
 * @property {number[][]} bands begin and end of the intervals in which the predicate holds
 */

/** The question as the server takes it; null if there is none, or one in SQL. */
export function predicate(recording) {
  const ask = state.get("ask");
  if (!ask || ask.kind !== "predicate" || !ask.topic) return null;
  const { topic, text, within } = ask;
  return { recording: recording.info.id, topic, where: text, within: within || null };
}

/**
 * Calls back with the matches in the visible range, now and whenever they change.
 *
 * @param {Object} recording
 * @param {function(): number} pixels width of the picture
 * @param {function(Matches|null)} callback
 * @returns {function()} ends it
 */
export function watchMatches(recording, pixels, callback) {
  const abort = new AbortController();
  let waiting = 0;
  const load = async () => {
    const asked = predicate(recording);
    if (!asked) {
      callback(null);
      return;
    }
    const begin = state.get("begin") ?? recording.info.begin;
    const end = Math.max(state.get("end") ?? recording.info.end, begin + 1);
    const range = { begin: Math.round(begin), end: Math.round(end), pixels: pixels() };
    try {
      const found = await get("matches", { ...asked, ...range }, { slot: "matches", signal: abort.signal });
      if (!abort.signal.aborted) callback({ ...found, topic: asked.topic });
    } catch (error) {
      if (isAborted(error)) return;
      if (!(error instanceof ApiError)) throw error;
      callback(null); // the bar says why
    }
  };
  const soon = () => {
    clearTimeout(waiting);
    waiting = setTimeout(load, 40);
  };
  const end = state.on(["ask", "begin", "end", "recording"], soon);
  load();
  return () => {
    end();
    clearTimeout(waiting);
    abort.abort();
  };
}
