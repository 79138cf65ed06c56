/** One recording: its head, and below it the parts of the page that show it. */

import { ApiError, get } from "./api.js";
import { mountAsk } from "./ask.js";
import { element, fill } from "./dom.js";
import { followLive, timed } from "./live.js";
import { firstTime, mountPanels } from "./panels.js";
import * as state from "./state.js";
import { mountTimeline } from "./timeline.js";
import { count, counted, duration, moment, size } from "./words.js";

/**
 * @typedef {Object} Recording
 * @property {string} name
 * @property {Object} info the answer of the server: topics, marks, losses; begin, end as BigInt
 * @property {BigInt} start the time that all other times count from, ns since 1970
 * @property {function(number|BigInt): BigInt} toTime ns since 1970 of a time since the start
 * @property {function(function()): function()} on calls back when `info` has changed, of a
 *     recording that goes on; returns a function that ends this
 * @property {function()} tell calls them back
 * @property {boolean} isUpdating whether the state changes because the recording has gone on:
 *     what is under way is answered before it is asked again
 */

/** Shows a recording in an element. Returns a function that takes it away. */
export function mountRecording(main, name) {
  const ends = [];
  let isGone = false;
  const head = element("p", { class: "summary" }, "…");
  main.append(head);
  load();
  return () => {
    isGone = true;
    ends.forEach((end) => end());
  };

  async function load() {
    try {
      const info = timed(await get("recording", { recording: name }));
      if (isGone) return;
      const recording = made(info);
      // Nothing was said of the cursor: at the very start most topics have no message yet.
      const isFresh = state.get("at") === 0n && state.get("panels") === null;
      if (isFresh && info.status !== "open") state.set({ at: firstTime(recording) });
      const drawHead = () => fill(head, summaryOf(recording));
      drawHead();
      ends.push(
        recording.on(drawHead),
        mountTimeline(main, recording),
        mountAsk(main, recording),
        mountPanels(main, recording),
        followLive(recording),
      );
    } catch (error) {
      if (!(error instanceof ApiError)) throw error;
      fill(main, element("pre", { class: "problem", role: "alert" }, error.message));
    }
  }
}

function made(info) {
  const listeners = new Set();
  const recording = {
    name: info.name,
    info,
    start: BigInt(info.start),
    toTime: (offset) => recording.start + state.instant(offset),
    on: (callback) => {
      listeners.add(callback);
      return () => listeners.delete(callback);
    },
    tell: () => listeners.forEach((callback) => callback()),
    isUpdating: false,
  };
  return recording;
}

function summaryOf({ info, start }) {
  const lost = info.losses.reduce((sum, loss) => sum + (loss.count ?? 0), 0);
  const parts = [
    moment(start, 0),
    duration(Number(info.end - info.begin)),
    counted(info.topics.length, "topic"),
    counted(info.messages, "message"),
    size(info.bytes),
    info.status === "open" ? "being recorded" : null,
    info.losses.length ? `${lost ? count(lost) : "messages"} lost` : null,
    ...Object.entries(info.tags).map(([key, value]) => `${key}=${value}`),
  ];
  return parts.filter(Boolean).join(" · ");
}
