/** Makes elements. Text from the store only ever becomes text, never markup. */

/**
 * An element with attributes, listeners and children.
 *
 * @param {string} tag
 * @param {Object} [attributes] `onclick` and the like are listeners; `class`, `title`, `data-…`
 *     and all others are attributes; false and null leave one out.
 * @param {...(Node|string|null)} children
 * @returns {HTMLElement}
 */
export function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === false || value === null || value === undefined) continue;
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name === "value") made.value = value;
    else made.setAttribute(name, value === true ? "" : value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

/** Puts these children in the place of all that an element has. */
export function fill(parent, ...children) {
  parent.replaceChildren(...children.filter((child) => child !== null && child !== undefined));
}

/** A button with a text, and a label that says what it does. */
export function button(text, label, onclick) {
  return element("button", { type: "button", title: label, "aria-label": label, onclick }, text);
}

/** Puts a text on the clipboard. */
export async function copied(text) {
  await navigator.clipboard.writeText(text);
  notice("Copied.");
}

let hiding = 0;

/** Says something in the head of the page for some seconds. */
export function notice(text) {
  const place = document.getElementById("notice");
  place.textContent = text;
  clearTimeout(hiding);
  hiding = setTimeout(() => (place.textContent = ""), 8000);
}
