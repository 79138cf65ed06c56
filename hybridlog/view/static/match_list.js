/** The list of matches, a page at a time, and the steps from one to the next. */

import { ApiError, Question, isAborted } from "./api.js";
import { element, fill, notice } from "./dom.js";
import { predicate } from "./matches.js";
import { seek } from "./range.js";
import * as state from "./state.js";
import { count, offset } from "./words.js";

const PAGE = 100;

/**
 * A list of the matches of the question.
 *
 * @param {Object} recording
 * @returns {{side: HTMLElement, show: function(number|null), update: function(number),
 *     step: function(string), destroy: function()}} `show` lists so many matches, null hides the
 *     list; `update` says that there are more by now; `step` moves the cursor to the `later` or
 *     `earlier` match
 */
export function matchList(recording) {
  const rows = element("ol", { class: "rows" });
  const title = element("span", {});
  const side = element(
    "aside",
    { class: "matches", "aria-label": "Matches", hidden: true },
    element(
      "header",
      {},
      title,
      button("‹", "Previous page of matches", () => page("earlier")),
      button("›", "Next page of matches", () => page("later")),
    ),
    rows,
  );
  let total = 0;
  let shown = { rows: [], before: 0 };
  const [pages, steps] = [new Question(), new Question()];
  const end = state.on(["at", "seq"], mark);
  return { side, show, update, step, destroy };

  function destroy() {
    end();
    pages.stop();
    steps.stop();
  }

  function show(number) {
    total = number ?? 0;
    side.hidden = number === null;
    shown = { rows: [], before: 0 };
    pages.stop();
    steps.stop();
    draw();
    if (number) load({ at: recording.info.begin, seq: -1, direction: "later" });
  }

  function update(number) {
    if (side.hidden) return show(number); // there was an error before
    if (number === total) return;
    total = number;
    const [first] = shown.rows;
    if (!first) load({ at: recording.info.begin, seq: -1, direction: "later" }, "update");
    else if (shown.rows.length < PAGE)
      load({ at: first[0], seq: first[1] - 1n, direction: "later" }, "update");
    else draw();
  }

  async function load(place, ask = "ask") {
    const found = await list({ ...place, count: PAGE }, pages, ask);
    if (!found?.rows.length) return;
    shown = found;
    draw();
  }

  /** Some matches at a place; null if there is no question, or a newer one. */
  async function list(place, question, ask) {
    const asked = predicate(recording);
    if (!asked) return null;
    try {
      const found = await question[ask]("match-list", { ...asked, ...place });
      return { ...found, rows: found.rows.map((row) => row.map(state.instant)) };
    } catch (error) {
      if (isAborted(error)) return null;
      if (!(error instanceof ApiError)) throw error;
      notice(error.message.split("\n")[0]);
      return null;
    }
  }

  function page(direction) {
    const edge = direction === "later" ? shown.rows.at(-1) : shown.rows[0];
    if (edge) load({ at: edge[0], seq: edge[1], direction });
  }

  async function step(direction) {
    const { at, seq } = state.get();
    const isBehind = seq === null && direction === "later"; // all messages of that time
    const place = { at: isBehind ? at + 1n : at, seq: isBehind ? -1n : (seq ?? -1n) };
    const found = await list({ ...place, direction, count: 1 }, steps, "ask");
    if (!found) return;
    if (!found.rows.length) {
      notice(direction === "later" ? "No later match." : "No earlier match.");
      return;
    }
    const [[time, own]] = found.rows;
    seek(recording, time, own);
    if (!shown.rows.some(([, known]) => known === own)) {
      await load({ at: time, seq: own - 1n, direction: "later" });
      mark();
    }
  }

  function draw() {
    const last = shown.before + shown.rows.length;
    title.textContent = shown.rows.length
      ? `${count(shown.before + 1)}–${count(last)} of ${count(total)}`
      : total
        ? "…"
        : "No match";
    fill(
      rows,
      ...shown.rows.map(([time, seq], number) =>
        element(
          "li",
          {},
          element(
            "button",
            { type: "button", class: "plain", onclick: () => seek(recording, time, seq) },
            element("small", {}, `#${count(shown.before + number + 1)} `),
            offset(time, 9),
          ),
        ),
      ),
    );
    mark();
  }

  /** Marks the match at the cursor. */
  function mark() {
    const { at, seq } = state.get();
    [...rows.children].forEach((row, number) => {
      const [time, own] = shown.rows[number] ?? [];
      const isCurrent = time === at && (seq === null || seq === own);
      row.toggleAttribute("aria-current", isCurrent);
      if (isCurrent) keepVisible(row);
    });
  }

  /** Scrolls the list, and nothing around it. */
  function keepVisible(row) {
    const low = row.offsetTop - rows.offsetTop; // the head stays in sight
    const high = row.offsetTop + row.offsetHeight;
    if (low < side.scrollTop) side.scrollTop = low;
    else if (high > side.scrollTop + side.clientHeight) side.scrollTop = high - side.clientHeight;
  }
}

function button(text, label, onclick) {
  return element("button", { type: "button", "aria-label": label, title: label, onclick }, text);
}
