/** A message as a tree; long arrays and texts are shown in parts. */

import { get } from "../api.js";
import { element, fill } from "../dom.js";
import { count, offset, size } from "../words.js";
import { follow } from "./follow.js";
import { literal, moment, opening } from "./python.js";

const PART = { texts: 100, items: 20, text: 1000 }; // elements, fields or characters of a part
const OPEN_LEVELS = 3;
const MAX_REMEMBERED = 40;

export default {
  kind: "message",
  title: "Message",
  accepts: () => true,
  mount,
  python: (panel) =>
    [
      opening(panel),
      `message = query.at(${moment(panel.recording, panel.cursor())})`,
      "print(message.content())",
    ].join("\n"),
};

function mount(body, panel) {
  const head = element("p", { class: "facts" }, " ");
  const place = element("div", { class: "tree" });
  body.append(head, place);
  const asked = { recording: panel.recording.info.id, topic: panel.topic.topic };
  let answer = null;
  let top = null;

  const following = follow({
    load: (at, signal) => get("message", { ...asked, at, seq: panel.seq() }, { signal }),
    show,
    fail: (error) => problem(error.message),
    panel,
  });

  function show(found) {
    answer = found;
    if (found.time === null) return problem("No message at or before the cursor.", false);
    fill(head, factsOf(found));
    if (found.problem) return problem(found.problem, true, factsOf(found));
    if (!top?.update(found.tree)) {
      top = treeOf(found.tree, [], [], view);
      fill(place, top.dom);
    }
    return undefined;
  }

  function problem(text, isProblem = true, facts = " ") {
    top = null;
    fill(head, facts);
    fill(place, element("pre", isProblem ? { class: "problem", role: "alert" } : { class: "note" }, text));
  }

  const view = {
    /** A part of the message that is shown; null if another one is shown by then. */
    async part(path, begin, number) {
      const of = answer;
      const found = await get("message", {
        ...asked,
        at: of.time,
        seq: of.seq,
        path: path.join("."),
        begin,
        count: number,
      });
      return of === answer && found.seq === of.seq ? found.tree : null;
    },
    isOpen(names) {
      const isUsual = names.length < OPEN_LEVELS;
      return toggled().includes(names.join(".")) !== isUsual;
    },
    toggle(names, isOpen) {
      if (view.isOpen(names) === isOpen) return;
      const name = names.join(".");
      const rest = toggled().filter((one) => one !== name);
      const isUsual = isOpen === names.length < OPEN_LEVELS;
      panel.setOptions({ toggled: isUsual ? rest : [...rest, name].slice(-MAX_REMEMBERED) });
    },
  };

  function toggled() {
    const { toggled: found } = panel.options;
    return Array.isArray(found) ? found.filter((one) => typeof one === "string") : [];
  }

  following.want(panel.cursor());
  return {
    update: () => following.want(panel.cursor()),
    destroy: () => following.destroy(),
  };
}

function factsOf(found) {
  const parts = [
    offset(found.time, 6),
    found.log_time,
    found.type,
    found.bytes === undefined ? null : size(found.bytes),
    found.reduced ? `its payload was ${found.reduced}: only fields of the index` : null,
  ];
  return parts.filter(Boolean).join(" · ");
}

/**
 * A node of the tree as an element that can take the values of another message.
 *
 * @param {Object} node as the server gives it
 * @param {number[]} path its place
 * @param {string[]} names the names above and of it
 * @returns {{dom: HTMLElement, update: function(Object): boolean}} `update` is false if the other
 *     node has another form
 */
function treeOf(node, path, names, view) {
  if ("n" in node && !("text" in node)) return branchOf(node, path, names, view);
  return leafOf(node, path, view);
}

function leafOf(node, path, view) {
  const value = element("span", { class: "value" });
  const kind = element("small", {});
  const pages = pagerOf("characters", PART.text, async (begin) => {
    const part = await view.part(path, begin, undefined);
    if (part) write(part);
  });
  const name = "name" in node ? element("span", { class: "name" }, node.name) : null;
  const dom = element("div", { class: "leaf" }, name, value, kind, pages.dom);
  write(node);
  return { dom, update };

  function write(found) {
    value.textContent = found.text;
    kind.textContent = found.type;
    pages.set(found.begin ?? 0, found.text.length, found.n ?? found.text.length);
  }

  function update(found) {
    if (!("text" in found) || found.name !== node.name) return false;
    write(found);
    return true;
  }
}

function branchOf(node, path, names, view) {
  const isObject = node.type === "";
  const kind = element("small", {});
  const inside = element("div", { class: "inside" });
  const plain = element("div", { class: "numbers" });
  const pages = pagerOf(isObject ? "fields" : "elements", PART.items, turn);
  const dom = element(
    "details",
    { open: view.isOpen(names) && !isClosed(node), ontoggle: toggled },
    element("summary", {}, element("span", { class: "name" }, node.name ?? ""), kind),
    plain,
    inside,
    pages.dom,
  );
  let children = [];
  let shown = node;
  write(node);
  return { dom, update };

  function write(found) {
    shown = found;
    kind.textContent = isObject ? (found.n ? "" : "{}") : found.type;
    const { texts, items } = found;
    pages.step = texts ? PART.texts : PART.items;
    pages.set(found.begin, (texts ?? items ?? []).length, found.n);
    plain.hidden = !texts;
    plain.textContent = texts ? texts.join("  ") : "";
    inside.hidden = !items;
    writeItems(items ?? [], found.begin);
  }

  function writeItems(items, begin) {
    items.forEach((item, place) => {
      const index = begin + place;
      const named = { ...item, name: item.name ?? `[${index}]` };
      const kept = children[place];
      if (kept?.index === index && kept.update(named)) return;
      const made = treeOf(named, [...path, index], [...names, named.name], view);
      if (kept) kept.dom.replaceWith(made.dom);
      else inside.append(made.dom);
      children[place] = { index, ...made };
    });
    children.splice(items.length).forEach((rest) => rest.dom.remove());
  }

  async function turn(begin) {
    const part = await view.part(path, begin, pages.step);
    if (part) write(part);
  }

  function toggled() {
    view.toggle(names, dom.open);
    if (dom.open && isClosed(shown)) turn(0);
  }

  function update(found) {
    const isBranch = "n" in found && !("text" in found);
    if (!isBranch || found.name !== node.name || (found.type === "") !== isObject) return false;
    const begin = shown.begin;
    if (begin && begin < found.n && found.begin !== begin) {
      // The reader has turned the page: stay on it.
      view.part(path, begin, pages.step).then((part) => part && write(part), () => write(found));
      return true;
    }
    write(found);
    if (dom.open && isClosed(found)) turn(0);
    return true;
  }
}

/** Whether there was no room in the answer for what is in a node. */
function isClosed({ items, texts, n }) {
  return n > 0 && !items && !texts;
}

/** "elements 0 to 63 of 720", with buttons for the parts before and behind. */
function pagerOf(what, step, turn) {
  const text = element("span", {});
  const back = element("button", { type: "button", "aria-label": `Earlier ${what}` }, "‹");
  const on = element("button", { type: "button", "aria-label": `Later ${what}` }, "›");
  const dom = element("div", { class: "pager", hidden: true }, back, text, on);
  const pager = { dom, step, set };
  let [begin, shown, total] = [0, 0, 0];
  back.addEventListener("click", () => turn(Math.max(begin - pager.step, 0)));
  on.addEventListener("click", () => turn(begin + shown));
  return pager;

  function set(...values) {
    [begin, shown, total] = values;
    dom.hidden = shown >= total;
    back.disabled = begin === 0;
    on.disabled = begin + shown >= total;
    text.textContent = `${what} ${count(begin)} to ${count(begin + shown - 1)} of ${count(total)}`;
  }
}
