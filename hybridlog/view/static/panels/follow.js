/** Keeps what a panel shows current at the cursor, without a queue of requests. */

import { ApiError } from "../api.js";
import { instant } from "../state.js";

/**
 * An answer about one message.
 *
 * @typedef {Object} Answer
 * @property {?BigInt} time log time of the message, ns since the start; null without one
 * @property {?BigInt} until log time of the next message; null if no later one is known
 */

/**
 * Asks for one message at a time. While an answer is under way only the newest cursor is
 * remembered, so messages are left out while it plays.
 *
 * @param {Object} parts
 * @param {function(BigInt, AbortSignal): Promise<Answer>} parts.load asks for the message at a
 *     time; its times are texts still
 * @param {function(Answer)} parts.show shows one
 * @param {function(Error)} parts.fail shows why there is none
 * @param {import("../panels.js").Panel} parts.panel
 */
export function follow({ load, show, fail, panel }) {
  const { recording } = panel;
  let shown = null; // the answer, and what it is of
  let wanted = null;
  let isRunning = false;
  const stopped = new AbortController();

  /** What an answer depends on beside the time. */
  function basis() {
    return JSON.stringify([String(panel.seq()), String(recording.start), recording.info.gone]);
  }

  function isShown() {
    if (shown?.of !== basis()) return false;
    return (shown.time ?? -Infinity) <= wanted && wanted < (shown.until ?? Infinity);
  }

  async function ask() {
    if (isRunning || isShown()) return;
    isRunning = true;
    const at = wanted;
    const of = basis();
    try {
      const answer = Object.assign(await load(at, stopped.signal), { of });
      for (const name of ["time", "until"]) answer[name] &&= instant(answer[name]);
      // Of a recording that goes on, later messages may come.
      if (answer.until === null && recording.info.status === "open") answer.until = at + 1n;
      if (stopped.signal.aborted) return;
      shown = answer;
      show(answer);
    } catch (error) {
      if (stopped.signal.aborted) return;
      if (!(error instanceof ApiError)) throw error;
      shown = null;
      fail(error);
    } finally {
      isRunning = false;
    }
    if (wanted !== at || of !== basis()) ask();
  }

  return {
    /** Shows the message that is current at a time. */
    want(at) {
      wanted = at;
      ask();
    },
    /** Forgets the answer, and asks again. */
    renew() {
      shown = null;
      if (wanted !== null) ask();
    },
    destroy: () => stopped.abort(),
  };
}
