/** The answer of a question in SQL: a table whose times lead to the moment. */

import { element } from "./dom.js";
import * as state from "./state.js";
import { count, counted } from "./words.js";

const TIMES = ["t", "log_time"];

/** A table of an answer of the server. */
export function sqlTable(answer) {
  const { columns, rows, at } = answer;
  const go = (time) => state.set({ at: state.instant(time) });
  const cell = (text, [name, isNumber], row) => {
    const shown =
      TIMES.includes(name) && at[row]
        ? element("button", { type: "button", class: "plain link", onclick: () => go(at[row]) }, text)
        : text;
    return element("td", { class: isNumber ? "number" : null }, shown);
  };
  return element(
    "div",
    { class: "answer" },
    element(
      "div",
      { class: "scrolls table", tabindex: "0", "aria-label": "Answer" },
      element(
        "table",
        {},
        element("thead", {}, element("tr", {}, ...columns.map(heading))),
        element(
          "tbody",
          {},
          ...rows.map((cells, row) =>
            element("tr", {}, ...cells.map((text, column) => cell(text, columns[column], row))),
          ),
        ),
      ),
    ),
    element("p", { class: "summary" }, summaryOf(answer)),
  );
}

function heading([name, isNumber]) {
  return element("th", { class: isNumber ? "number" : null, scope: "col" }, name);
}

function summaryOf({ rows, more, columns_left_out: leftOut, remarks }) {
  const words = counted(rows.length, "row");
  return [
    more ? `The first ${words}; the answer has more. \`hybridlog sql\` gives all` : words,
    leftOut ? `${count(leftOut)} further columns are left out` : null,
    ...remarks,
  ]
    .filter(Boolean)
    .join(". ");
}
