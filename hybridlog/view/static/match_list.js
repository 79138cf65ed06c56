/** The list of episodes in which the question holds, a page at a time, and the steps between them. */

import { ApiError, Question, isAborted } from "./api.js";
import { button, element, fill, notice } from "./dom.js";
import { predicate } from "./matches.js";
import { seek } from "./range.js";
import * as state from "./state.js";
import { count, counted, duration, offset } from "./words.js";

const PAGE = 100;

/**
 * A list of the episodes of the question: rows of matches.
 *
 * @param {Object} recording
 * @returns {{side: HTMLElement, show: function(boolean), update: function(),
 *     step: function(string), destroy: function()}} `show` lists them from the first one on, or
 *     hides the list; `update` asks again, as there may be more by now; `step` moves the cursor to
 *     the `later` or `earlier` one
 */
export function matchList(recording) {
  const rows = element("ol", { class: "rows" });
  const title = element("span", {});
  const head = element(
    "header",
    {},
    title,
    button("‹", "Previous page of matches", () => page("earlier")),
    button("›", "Next page of matches", () => page("later")),
  );
  const side = element("aside", { class: "matches", "aria-label": "Matches", hidden: true }, head, rows);
  const first = () => ({ at: recording.info.begin, seq: -1n, direction: "later" });
  let shown = { rows: [], before: 0, all: 0 };
  const [pages, steps] = [new Question(), new Question()];
  const end = state.on(["at", "seq"], mark);
  return { side, show, update, step, destroy };

  function destroy() {
    end();
    pages.stop();
    steps.stop();
  }

  function show(isShown) {
    side.hidden = !isShown;
    pages.stop();
    steps.stop();
    shown = { rows: [], before: 0, all: 0 };
    draw();
    if (isShown) load(first());
  }

  function update() {
    if (side.hidden) return show(true); // there was an error before
    const [top] = shown.rows;
    return load(top ? { at: top.at, seq: top.seq - 1n, direction: "later" } : first(), "update");
  }

  async function load(place, ask = "ask") {
    const found = await list({ ...place, count: PAGE }, pages, ask);
    if (!found || (!found.rows.length && shown.rows.length)) return;
    shown = found;
    draw();
  }

  /** Some episodes at a place; null if there is no question, or a newer one. */
  async function list(place, question, ask) {
    const asked = predicate(recording);
    if (!asked) return null;
    try {
      const found = await question[ask]("episodes", { ...asked, ...place });
      const rows = found.rows.map((row) => [...row.slice(0, 3).map(BigInt), row[3]]);
      return { ...found, rows: rows.map(([at, until, seq, matches]) => ({ at, until, seq, matches })) };
    } catch (error) {
      if (isAborted(error)) return null;
      if (!(error instanceof ApiError)) throw error;
      notice(error.message.split("\n")[0]);
      return null;
    }
  }

  function page(direction) {
    const edge = direction === "later" ? shown.rows.at(-1) : shown.rows[0];
    if (edge) load({ at: edge.at, seq: edge.seq, direction });
  }

  async function step(direction) {
    const { at, seq } = state.get();
    const isBehind = seq === null && direction === "later"; // all messages of that time
    const place = { at: isBehind ? at + 1n : at, seq: isBehind ? -1n : (seq ?? -1n) };
    const found = await list({ ...place, direction, count: 1 }, steps, "ask");
    if (!found) return;
    const [one] = found.rows;
    if (!one) return notice(direction === "later" ? "No later match." : "No earlier match.");
    seek(recording, one.at, one.seq);
    if (shown.rows.some(({ seq: known }) => known === one.seq)) return;
    await load({ at: one.at, seq: one.seq - 1n, direction: "later" });
    mark();
  }

  function draw() {
    const last = shown.before + shown.rows.length;
    title.textContent = shown.rows.length
      ? `${count(shown.before + 1)}–${count(last)} of ${counted(shown.all, "episode")}`
      : "…";
    fill(
      rows,
      ...shown.rows.map(({ at, until, seq, matches }, number) => {
        const go = () => seek(recording, at, seq);
        const about = `${duration(Number(until - at))} · ${counted(matches, "match", "matches")}`;
        const parts = [
          element("small", {}, `#${count(shown.before + number + 1)} `),
          offset(at, 9),
          element("small", { class: "about" }, about),
        ];
        return element("li", {}, element("button", { type: "button", class: "plain", onclick: go }, ...parts));
      }),
    );
    mark();
  }

  /** Marks the episode at the cursor. */
  function mark() {
    const { at, seq } = state.get();
    [...rows.children].forEach((row, number) => {
      const one = shown.rows[number];
      const isHere = one.at <= at && (at < one.until || at === one.at);
      const isCurrent = isHere && (seq === null || seq === one.seq);
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
