/** Keeps a recording up to date while the page is seen: its messages, marks, losses, what expires. */

import { ApiError, get } from "./api.js";
import { lastTime, show, visible } from "./range.js";
import * as state from "./state.js";

const EVERY_MS = 1000; // while it is being recorded
const ENDED_MS = 3000;

/** What the server says of a recording, with times as BigInt. */
export function timed(found) {
  const first = (topic) => (topic.first ? state.instant(topic.first) : null);
  const topics = found.topics.map((topic) => ({ ...topic, first: first(topic) }));
  return { ...found, begin: state.instant(found.begin), end: state.instant(found.end), topics };
}

/** Keeps `recording.info` up to date. Returns a function that ends this. */
export function followLive(recording) {
  let known = "";
  const stop = new AbortController();
  const isOpen = () => recording.info.status === "open";
  if (isOpen() && state.get("at") === 0n) state.set({ at: lastTime(recording) });
  const wait = () => setTimeout(look, isOpen() ? EVERY_MS : ENDED_MS);
  let timer = wait();
  return () => {
    clearTimeout(timer);
    stop.abort();
  };

  async function look() {
    try {
      if (!document.hidden) await update();
    } catch (error) {
      // A server that does not answer now may do so later.
      if (!(error instanceof ApiError) && error.name !== "AbortError") throw error;
    }
    if (!stop.signal.aborted) timer = wait();
  }

  async function update() {
    const parameters = { recording: recording.info.id };
    const found = await get("recording", parameters, { signal: stop.signal });
    const text = JSON.stringify(found);
    if (text === known) return;
    known = text;
    recording.isUpdating = true;
    try {
      take(timed(found));
    } finally {
      recording.isUpdating = false;
    }
  }

  /** Shows what is new. */
  function take(found) {
    const { info } = recording;
    const isAtEnd = state.get("at") >= lastTime(recording);
    const before = info.end;
    moveStart(BigInt(found.start));
    Object.assign(info, found);
    if (isAtEnd && info.end !== before) {
      const { begin, end } = visible(recording);
      const by = Number(info.end - before);
      if (state.get("begin") !== null) show(recording, begin + by, end + by);
      state.set({ at: lastTime(recording) });
    }
    recording.tell();
  }

  /** Times count from the first message; a late one may be before it. */
  function moveStart(start) {
    const by = recording.start - start;
    if (!by) return;
    recording.start = start;
    const moved = (time) => (time === null ? null : time + by);
    const { begin, end, at, seq } = state.get();
    recording.info.end += by;
    recording.info.begin += by;
    state.set({ begin: moved(begin), end: moved(end), at: at + by, seq });
  }
}
