/** The matches of the question, and warnings in logs, drawn over the timeline in the visible range. */

import { ApiError, Question, isAborted } from "./api.js";
import * as overlays from "./overlays.js";
import { exactRange } from "./range.js";
import * as state from "./state.js";

const MAX_PIXELS = 2048;
const PAUSE_MS = 40;
/** What is a warning or worse, by type. */
const TROUBLES = {
  "rosgraph_msgs/Log": "level >= 4",
  "rcl_interfaces/Log": "level >= 30",
  "foxglove_msgs/Log": "level >= 3",
  "foxglove.Log": "level >= 3",
  "diagnostic_msgs/DiagnosticArray": "status[].level >= 1",
};

/** The question as the server takes it; null if there is none, or one in SQL. */
export function predicate(recording) {
  const ask = state.get("ask");
  if (!ask || ask.kind !== "predicate" || !ask.topic) return null;
  const { topic, text, within } = ask;
  return { recording: recording.info.id, topic, where: text, within: within || null };
}

/** Whether messages of a type may tell of trouble. */
export function tellsTrouble(type) {
  return type.replace("/msg/", "/") in TROUBLES;
}

/**
 * Draws the matches as ticks, and bands where the predicate holds; warnings and errors are ticks
 * on the lane of their topic. Returns a function that ends it.
 */
export function drawMatches(recording) {
  const ends = [drawn(recording, "matches", () => predicate(recording))];
  const known = new Set();
  const offer = () => {
    for (const { topic, type, messages } of recording.info.topics) {
      if (!messages || !tellsTrouble(type) || known.has(topic)) continue;
      known.add(topic);
      const asked = { recording: recording.info.id, topic, where: TROUBLES[type.replace("/msg/", "/")] };
      ends.push(drawn(recording, `trouble ${topic}`, () => asked, topic));
    }
  };
  offer();
  ends.push(recording.on(offer));
  return () => ends.forEach((end) => end());
}

/** Draws the answers of what is asked, on one lane or on all; gives what ends it. */
function drawn(recording, name, question, lane = null) {
  const asking = new Question();
  let waiting = 0;
  const ends = [state.on(["ask", "begin", "end"], soon), recording.on(load)];
  load();
  return () => {
    ends.forEach((end) => end());
    clearTimeout(waiting);
    asking.stop();
    overlays.draw(name, null);
  };

  function soon() {
    if (recording.isUpdating) return; // which is told when all is known
    clearTimeout(waiting);
    waiting = setTimeout(load, PAUSE_MS);
  }

  async function load() {
    const asked = question();
    if (!asked) {
      asking.stop();
      overlays.draw(name, null);
      return;
    }
    const pixels = Math.min(window.innerWidth, MAX_PIXELS);
    try {
      const ask = recording.isUpdating ? "update" : "ask";
      const picture = { ...asked, ...exactRange(recording), pixels };
      const { first, counts, bands } = await asking[ask]("matches", picture);
      const ticks = first.map((time, n) => [time, counts[n]]);
      const title = lane ? "Warnings and errors" : `${asked.topic}: ${asked.where}`;
      overlays.draw(name, { title, lane, ticks, bands: lane ? [] : bands });
    } catch (error) {
      if (isAborted(error)) return;
      if (!(error instanceof ApiError)) throw error;
      overlays.draw(name, null); // the bar says why
    }
  }
}
