/** Parts of the recording as a file: the command line that writes it, and the same in Python. */

import { ApiError, Question, isAborted } from "./api.js";
import { copied, element, fill } from "./dom.js";
import { predicate } from "./matches.js";
import * as state from "./state.js";
import { counted } from "./words.js";

/** What can be exported, and what the server has to know for it. */
const PARTS = {
  range: { title: "This range, all topics", ask: (asked, range) => range },
  matches: { title: "Matches in this range", ask: (asked, range) => ({ ...asked, ...range }) },
};

/**
 * A form to export a part of the recording.
 *
 * @param {Object} recording
 * @returns {{form: HTMLElement, toggle: function(), destroy: function()}}
 */
export function exportForm(recording) {
  const part = element("select", { "aria-label": "Part to export", onchange: load });
  const told = element("span", { role: "status" });
  const command = element("pre", { class: "command", tabindex: "0", "aria-label": "Command line" });
  const problem = element("pre", { class: "problem", role: "alert", hidden: true });
  let python = "";
  const asking = new Question();
  const copies = element(
    "span",
    { class: "copies" },
    copy("Copy command", () => command.textContent),
    copy("Copy as Python", () => python),
  );
  const form = element(
    "section",
    { class: "export", "aria-label": "Export", hidden: true },
    element("p", { class: "row" }, part, told),
    command,
    copies,
    problem,
  );
  const end = state.on(["ask", "begin", "end"], () => form.hidden || draw());
  return { form, toggle, destroy };

  function destroy() {
    end();
    asking.stop();
  }

  function toggle() {
    form.hidden = !form.hidden;
    if (form.hidden) return asking.stop();
    draw();
    return part.focus();
  }

  function draw() {
    const chosen = part.value;
    const offered = predicate(recording) ? Object.keys(PARTS) : ["range"];
    fill(part, ...offered.map((name) => element("option", { value: name }, PARTS[name].title)));
    if (offered.includes(chosen)) part.value = chosen;
    load();
  }

  async function load() {
    const { begin, end } = { begin: state.get("begin"), end: state.get("end") };
    const range = begin === null ? {} : { begin, end };
    const asked = {
      recording: recording.info.id,
      ...PARTS[part.value].ask(predicate(recording) ?? {}, range),
    };
    try {
      const ask = recording.isUpdating ? "update" : "ask";
      const found = await asking[ask]("ask", asked);
      told.textContent = found.lost ?? counted(found.count, "message");
      command.textContent = found.command;
      python = found.python;
      problem.hidden = true;
      copies.hidden = false;
    } catch (error) {
      if (isAborted(error)) return;
      if (!(error instanceof ApiError)) throw error;
      told.textContent = command.textContent = "";
      problem.textContent = error.message;
      problem.hidden = false;
      copies.hidden = true;
    }
  }
}

function copy(title, text) {
  return element("button", { type: "button", onclick: () => copied(text()) }, title);
}
