/** The bar that takes questions, and below it their answers. */

import { ApiError, Question, isAborted } from "./api.js";
import { button, copied, element, fill } from "./dom.js";
import { exportForm } from "./export.js";
import { matchList } from "./match_list.js";
import { drawMatches, predicate } from "./matches.js";
import { sqlTable } from "./sql_table.js";
import * as state from "./state.js";
import { counted } from "./words.js";

/** Shows the bar. Returns a function that takes it away. */
export function mountAsk(main, recording) {
  const kind = element(
    "select",
    { "aria-label": "Language", onchange: adapt },
    element("option", { value: "predicate" }, "Where"),
    element("option", { value: "sql" }, "SQL"),
  );
  const topic = element("select", { "aria-label": "Topic of the question" });
  const text = element("input", {
    class: "question",
    type: "text",
    "aria-label": "Question",
    autocomplete: "off",
    autocapitalize: "off",
    spellcheck: "false",
    maxlength: 10000,
    oninput: adapt,
    onkeydown: pressed,
  });
  const within = element("input", {
    "aria-label": "Time within which messages of other topics are",
    placeholder: "within 0.1s",
    title: "How near in time messages of other topics are: 0.1s",
    size: 10,
    maxlength: 64,
  });
  const list = matchList(recording);
  const files = exportForm(recording);
  const told = element("span", { class: "told", role: "status" });
  const steps = element(
    "span",
    { class: "steps", hidden: true },
    button("‹ Previous", "Previous match (p)", () => list.step("earlier")),
    button("Next ›", "Next match (n)", () => list.step("later")),
  );
  const copy = button("Copy as Python", "Copy the question as Python", () => copied(python));
  const clear = button("Clear", "Clear the question", () => state.set({ ask: null }, { isStep: true }));
  const body = element("div", { class: "body" });
  const bar = element(
    "form",
    { class: "bar", role: "search", "aria-label": "Ask", onsubmit: submit },
    kind,
    topic,
    text,
    within,
    element("button", {}, "Ask"),
    button("Export", "Export this range or the matches", files.toggle),
  );
  let python = "";
  const asking = new Question();
  const place = element(
    "section",
    { class: "ask", "aria-label": "Questions" },
    bar,
    element("p", { class: "row" }, told, steps, copy, clear),
    files.form,
    body,
  );
  main.append(place, list.side);
  document.addEventListener("keydown", key);
  offer();
  const ends = [
    state.on(["ask"], answer),
    recording.on(offer), // topics may have come
    recording.on(update),
    drawMatches(recording),
  ];
  answer();
  return () => {
    ends.forEach((end) => end());
    asking.stop();
    list.destroy();
    files.destroy();
    document.removeEventListener("keydown", key);
  };

  function adapt() {
    const isSql = kind.value === "sql";
    topic.hidden = isSql;
    within.hidden = isSql || !/:(\s|$)/.test(text.value);
    text.placeholder = isSql ? "select … from …" : "ranges.min < 0.5";
  }

  function written() {
    return { kind: kind.value, topic: topic.value, text: text.value.trim(), within: within.value.trim() };
  }

  function write(question) {
    kind.value = question.kind === "sql" ? "sql" : "predicate";
    if (topics().some((one) => one.topic === question.topic)) topic.value = question.topic;
    text.value = question.text;
    within.value = typeof question.within === "string" ? question.within : "";
    adapt();
  }

  function submit(event) {
    event.preventDefault();
    const question = written();
    if (!question.text) {
      state.set({ ask: null }, { isStep: true });
      return;
    }
    if (within.hidden) question.within = "";
    if (JSON.stringify(state.get("ask")) === JSON.stringify(question)) answer();
    else state.set({ ask: question }, { isStep: true });
  }

  /** Asks the question of the state. */
  async function answer() {
    asking.stop();
    const question = state.get("ask");
    list.show(false);
    steps.hidden = true;
    copy.hidden = clear.hidden = !question;
    fill(body);
    told.textContent = question ? "…" : "";
    if (!question) {
      if (!place.contains(document.activeElement)) write({ kind: "predicate", topic: firstTopic(), text: "" });
      return;
    }
    write(question);
    try {
      if (question.kind === "sql") await answerSql(question);
      else await answerPredicate();
    } catch (error) {
      if (isAborted(error)) return;
      if (!(error instanceof ApiError)) throw error;
      told.textContent = "";
      copy.hidden = true;
      fill(body, element("pre", { class: "problem", role: "alert" }, error.message));
    }
  }

  async function answerPredicate() {
    const asked = predicate(recording);
    if (!asked) throw new ApiError("Choose a topic for the question.");
    const found = await asking.ask("ask", asked);
    tell(found);
    list.show(true);
  }

  /** Counts again what has been recorded since. */
  async function update() {
    const asked = predicate(recording);
    if (!asked || body.querySelector(".problem")) return;
    try {
      const found = await asking.update("ask", asked);
      tell(found);
      list.update();
    } catch (error) {
      // The next update may be answered.
      if (!isAborted(error) && !(error instanceof ApiError)) throw error;
    }
  }

  function tell(found) {
    python = found.python;
    told.textContent = found.lost ?? counted(found.count, "match", "matches");
    fill(body, ...found.remarks.map((line) => element("p", { class: "summary" }, line)));
    steps.hidden = !found.count;
  }

  async function answerSql(question) {
    const found = await asking.ask("sql", { recording: recording.info.id, text: question.text });
    python = found.python;
    told.textContent = "";
    fill(body, sqlTable(found));
  }

  function topics() {
    return recording.info.topics.filter(({ messages }) => messages);
  }

  /** Fills the menu of topics; the one that is chosen stays. */
  function offer() {
    const names = topics().map((one) => one.topic);
    if (names.length === topic.options.length) return;
    const chosen = topic.value || firstTopic();
    fill(topic, ...names.map((name) => element("option", { value: name }, name)));
    topic.value = names.includes(chosen) ? chosen : (names[0] ?? "");
  }

  function firstTopic() {
    return state.get("panels")?.[0]?.topic ?? topics()[0]?.topic;
  }

  function pressed(event) {
    if (event.key === "Escape") {
      event.stopPropagation();
      text.blur();
    }
  }

  function key(event) {
    const isTyping = event.target.closest?.("input, select, textarea, [contenteditable]");
    if (isTyping || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "/") {
      event.preventDefault();
      text.focus();
      text.select();
    } else if (event.key === "n" || event.key === "p") {
      if (predicate(recording)) list.step(event.key === "n" ? "later" : "earlier");
    }
  }
}
