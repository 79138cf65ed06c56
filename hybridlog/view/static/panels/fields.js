/** A list of fields to choose from, with a search. */

import { element, fill } from "../dom.js";

const MAX_SHOWN = 300;
let made = 0;

/**
 * @param {Object} parts
 * @param {number} parts.most most fields that may be chosen
 * @param {function(string[])} parts.choose is told the chosen fields
 */
export function fieldPicker({ most, choose }) {
  let known = [];
  let chosen = [];
  const id = `fields-${(made += 1)}`;
  const search = element("input", {
    type: "search",
    placeholder: "Search fields",
    "aria-label": "Search fields",
    autocomplete: "off",
    oninput: draw,
    onkeydown: (event) => event.key === "Enter" && add(),
  });
  const list = element("div", { class: "choices", role: "group", "aria-label": "Fields" });
  const inside = element("div", { class: "popup", id, hidden: true }, search, list);
  const button = element(
    "button",
    { type: "button", "aria-expanded": "false", "aria-controls": id, onclick: () => show(inside.hidden) },
    "Fields…",
  );
  const dom = element("span", { class: "picker" }, button, inside);
  dom.addEventListener("keydown", (event) => {
    if (event.key !== "Escape" || inside.hidden) return;
    event.stopPropagation();
    show(false);
    button.focus();
  });
  dom.addEventListener("focusout", (event) => {
    if (event.relatedTarget && !dom.contains(event.relatedTarget)) show(false);
  });
  const closing = (event) => dom.contains(event.target) || show(false);
  document.addEventListener("pointerdown", closing);
  return { dom, set, destroy: () => document.removeEventListener("pointerdown", closing) };

  function set(fields, names) {
    [known, chosen] = [fields, names];
    if (!inside.hidden) draw();
  }

  function show(isShown) {
    inside.hidden = !isShown;
    button.setAttribute("aria-expanded", String(isShown));
    if (!isShown) return;
    draw();
    search.focus();
    search.select();
  }

  function found() {
    const words = search.value.toLowerCase().split(/\s+/).filter(Boolean);
    return known.filter(({ path }) => words.every((word) => path.toLowerCase().includes(word)));
  }

  function draw() {
    const fields = found();
    const rows = fields.slice(0, MAX_SHOWN).map(({ path, type }) => {
      const isChosen = chosen.includes(path);
      const box = element("input", {
        type: "checkbox",
        checked: isChosen,
        disabled: !isChosen && chosen.length >= most,
        onchange: () => change(path, box.checked),
      });
      return element("label", {}, box, ` ${path} `, element("small", {}, type));
    });
    const rest = fields.length - rows.length;
    const note = rest ? `and ${rest} more` : fields.length ? null : "Enter adds what is written.";
    const focused = document.activeElement?.closest?.("label")?.textContent;
    fill(list, ...rows, note && element("p", {}, note));
    // The list was made anew, and the keyboard stays where it was.
    if (focused) rows.find((row) => row.textContent === focused)?.firstChild.focus();
  }

  /** Takes the only field that is found, or what is written, such as `position[2]`. */
  function add() {
    const fields = found();
    const path = fields.length === 1 ? fields[0].path : search.value.trim();
    if (!path || chosen.includes(path) || chosen.length >= most) return;
    search.value = "";
    change(path, true);
  }

  function change(path, isChosen) {
    choose(isChosen ? [...chosen, path] : chosen.filter((one) => one !== path));
  }
}
