/** Completion of a question, and its history, at an input. */

import { ApiError, Question, isAborted } from "./api.js";
import { element, fill } from "./dom.js";

const HISTORY = "hybridlog.questions";
const MOST = 100;

/**
 * Offers what may be written. Tab takes the first candidate, and again the next one.
 *
 * @param {HTMLInputElement} input
 * @param {function(): Object} context what the server has to know: recording, topic; null for no candidates
 * @returns {{list: HTMLElement, close: function(): boolean}} the list, to be put beside the input;
 *     `close` says whether it was open
 */
export function completed(input, context) {
  const asking = new Question();
  const list = element("ul", { class: "candidates", role: "listbox", id: "candidates", hidden: true });
  let found = null; // { begin, candidates, place, taken }
  let waiting = 0;
  let turn = 0; // changes when the candidates are no longer wanted
  let isLoading = false;
  let takesFirst = false; // Tab came before the candidates
  input.setAttribute("aria-controls", "candidates");
  input.setAttribute("aria-expanded", "false");
  input.addEventListener("input", () => {
    clearTimeout(waiting);
    close();
    isLoading = true;
    waiting = setTimeout(load, 120);
  });
  input.addEventListener("keydown", (event) => {
    if (event.key !== "Tab" || !(isLoading || found?.candidates.length)) return;
    event.preventDefault();
    if (isLoading) {
      takesFirst = true;
      return;
    }
    const step = event.shiftKey ? found.candidates.length - 1 : 1;
    take((found.taken < 0 ? (event.shiftKey ? 0 : -1) : found.taken) + step);
  });
  input.addEventListener("blur", close);
  return { list, close };

  async function load() {
    const mine = turn;
    const place = input.selectionStart;
    let answer = null;
    try {
      const about = context();
      answer = about && (await asking.ask("complete", { ...about, text: input.value, place }));
    } catch (error) {
      if (isAborted(error)) return;
      if (!(error instanceof ApiError)) throw error; // what is wrong is said when it is asked
    }
    if (mine !== turn) return;
    isLoading = false;
    found = answer && { ...answer, place, taken: -1 };
    if (takesFirst && found?.candidates.length) take(0);
    else draw();
    takesFirst = false;
  }

  function draw() {
    const offered = found?.candidates ?? [];
    const typed = found ? input.value.slice(found.begin, found.place) : "";
    list.hidden = !offered.length || (offered.length === 1 && offered[0][0] === typed);
    input.setAttribute("aria-expanded", String(!list.hidden));
    const rows = offered.map(([text, kind, type], number) =>
      element(
        "li",
        {
          role: "option",
          class: kind,
          "aria-selected": String(number === found.taken),
          // Before the input loses the focus.
          onmousedown: (event) => {
            event.preventDefault();
            take(number);
          },
        },
        text,
        element("small", {}, type),
      ),
    );
    fill(list, ...rows);
    rows[found?.taken]?.scrollIntoView({ block: "nearest" });
  }

  function take(number) {
    found.taken = number % found.candidates.length;
    const [text] = found.candidates[found.taken];
    const rest = input.value.slice(found.place);
    input.value = input.value.slice(0, found.begin) + text + rest;
    found.place = found.begin + text.length;
    input.setSelectionRange(found.place, found.place);
    draw();
  }

  function close() {
    clearTimeout(waiting);
    asking.stop();
    turn += 1;
    const wasOpen = !list.hidden;
    found = null;
    isLoading = takesFirst = false;
    list.hidden = true;
    input.setAttribute("aria-expanded", "false");
    return wasOpen;
  }
}

/**
 * Earlier questions, which stay in this browser.
 *
 * @returns {{add: function(Object), step: function(number, Object): Object|null}} `step` gives the
 *     question so many steps later; the one behind the last is `now`
 */
export function questionHistory() {
  let place = null;
  let draft = null;
  return { add, step };

  function add(question) {
    const text = JSON.stringify(question);
    const others = load().filter((one) => JSON.stringify(one) !== text);
    place = null;
    try {
      localStorage.setItem(HISTORY, JSON.stringify([...others, question].slice(-MOST)));
    } catch {
      // Without storage, there is no history.
    }
  }

  function step(by, now) {
    const known = load();
    if (place === null) draft = now;
    const next = (place ?? known.length) + by;
    if (next < 0 || next > known.length) return null;
    place = next === known.length ? null : next;
    return place === null ? draft : known[place];
  }

  function load() {
    try {
      const found = JSON.parse(localStorage.getItem(HISTORY));
      return Array.isArray(found) ? found.filter((one) => typeof one?.text === "string") : [];
    } catch {
      return [];
    }
  }
}
