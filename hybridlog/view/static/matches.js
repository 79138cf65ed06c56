/** The matches of the question, drawn over the timeline in the visible range. */

import { ApiError, Question, isAborted } from "./api.js";
import * as overlays from "./overlays.js";
import { exactRange } from "./range.js";
import * as state from "./state.js";

const NAME = "matches";
const MAX_PIXELS = 2048;
const PAUSE_MS = 40;

/** The question as the server takes it; null if there is none, or one in SQL. */
export function predicate(recording) {
  const ask = state.get("ask");
  if (!ask || ask.kind !== "predicate" || !ask.topic) return null;
  const { topic, text, within } = ask;
  return { recording: recording.info.id, topic, where: text, within: within || null };
}

/** Draws the matches as ticks, and bands where the predicate holds. Returns a function that ends it. */
export function drawMatches(recording) {
  const asking = new Question();
  let waiting = 0;
  const ends = [state.on(["ask", "begin", "end"], soon), recording.on(load)];
  load();
  return () => {
    ends.forEach((end) => end());
    clearTimeout(waiting);
    asking.stop();
    overlays.draw(NAME, null);
  };

  function soon() {
    if (recording.isUpdating) return; // which is told when all is known
    clearTimeout(waiting);
    waiting = setTimeout(load, PAUSE_MS);
  }

  async function load() {
    const asked = predicate(recording);
    if (!asked) {
      asking.stop();
      overlays.draw(NAME, null);
      return;
    }
    const pixels = Math.min(window.innerWidth, MAX_PIXELS);
    const picture = { ...exactRange(recording), pixels };
    try {
      const ask = recording.isUpdating ? "update" : "ask";
      const { first, counts, bands } = await asking[ask]("matches", { ...asked, ...picture });
      const ticks = first.map((time, n) => [time, counts[n]]);
      overlays.draw(NAME, { title: `${asked.topic}: ${asked.where}`, ticks, bands });
    } catch (error) {
      if (isAborted(error)) return;
      if (!(error instanceof ApiError)) throw error;
      overlays.draw(NAME, null); // the bar says why
    }
  }
}
