/** A plane seen from above, with a grid in metres, which can be moved and zoomed. */

import { element } from "../dom.js";
import { Colours } from "../paint.js";
import { onTheme } from "./colours.js";

const LEAST_SCALE = 1e-6; // pixels a metre
const MAX_SCALE = 1e5;
const GRID_PIXELS = 70; // least distance of lines
const MARGIN = 1.15;
const STEP = 0.12; // part of the picture that an arrow key moves it by
const CLICK = 4; // pixels that a click may move

/** The largest of 1, 2 and 5 times a power of ten that is not below a number, if it is above 0. */
export function niceStep(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((factor) => factor * power).find((step) => step >= least * 0.999);
}

/** A length in words: `5 m`, `20 cm` or `2 km`. */
export function metres(length) {
  const size = Math.abs(length);
  if (size >= 1000) return `${Number((length / 1000).toPrecision(6))} km`;
  if (size >= 1 || size === 0) return `${Number(length.toPrecision(6))} m`;
  return size >= 0.01
    ? `${Number((length * 100).toPrecision(4))} cm`
    : `${Number((length * 1000).toPrecision(4))} mm`;
}

/**
 * @typedef {Object} View
 * @property {function(number): number} x pixel of metres to the right
 * @property {function(number): number} y pixel of metres upwards
 * @property {number} scale pixels a metre
 * @property {number} width
 * @property {number} height
 * @property {Object<string, string>} theme colours
 */

/**
 * Puts a plane into an element.
 *
 * @param {HTMLElement} parent
 * @param {Object} parts
 * @param {string} parts.label for those who cannot see it
 * @param {function(CanvasRenderingContext2D, View)} parts.paint what is on the plane
 * @param {function(number, number, number)} [parts.pick] a click: metres, and metres of a pixel
 */
export function plane(parent, { label, paint, pick }) {
  const canvas = element("canvas", {
    class: "plane",
    tabindex: 0,
    role: "img",
    "aria-label": `${label}. Arrow keys move it, plus and minus zoom, 0 shows all.`,
  });
  parent.append(canvas);
  const context = canvas.getContext("2d");
  const colours = new Colours(parent);
  let centre = { x: 0, y: 0 };
  let scale = 20;
  let box = null;
  let isOwn = false; // whether the user has chosen the view
  let pending = 0;
  let size = { width: 1, height: 1 };

  const watching = new ResizeObserver(() => {
    const { width, height } = canvas.getBoundingClientRect();
    if (!width || !height) return;
    size = { width, height };
    canvas.width = Math.round(width * devicePixelRatio);
    canvas.height = Math.round(height * devicePixelRatio);
    if (!isOwn) show();
    draw(); // at once, since a canvas is emptied when its size changes
  });
  watching.observe(canvas);
  const endTheme = onTheme(() => {
    colours.forget();
    redraw();
  });

  const view = () => ({
    x: (right) => size.width / 2 + (right - centre.x) * scale,
    y: (up) => size.height / 2 - (up - centre.y) * scale,
    scale,
    ...size,
    theme: colours.all(),
  });

  function show() {
    if (!box) return;
    centre = { x: (box.left + box.right) / 2, y: (box.bottom + box.top) / 2 };
    const wide = Math.max(box.right - box.left, 1e-3) * MARGIN;
    const high = Math.max(box.top - box.bottom, 1e-3) * MARGIN;
    scale = bounded(Math.min(size.width / wide, size.height / high));
  }

  function redraw() {
    pending ||= requestAnimationFrame(draw);
  }

  function draw() {
    cancelAnimationFrame(pending);
    pending = 0;
    context.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    context.clearRect(0, 0, size.width, size.height);
    const seen = view();
    paintGrid(context, seen, centre);
    paint(context, seen);
    canvas.dataset.view = [centre.x, centre.y, scale].map((n) => n.toPrecision(6)).join(" ");
  }

  function move(right, up) {
    isOwn = true;
    centre = { x: centre.x + right, y: centre.y + up };
    redraw();
  }

  /** Zooms about a pixel, which keeps its place. */
  function zoom(factor, at = { x: size.width / 2, y: size.height / 2 }) {
    isOwn = true;
    const before = scale;
    scale = bounded(scale * factor);
    const shift = 1 / before - 1 / scale;
    centre = {
      x: centre.x + (at.x - size.width / 2) * shift,
      y: centre.y - (at.y - size.height / 2) * shift,
    };
    redraw();
  }

  function reset() {
    isOwn = false;
    show();
    redraw();
  }

  follow(canvas, {
    drag: (dx, dy) => move(-dx / scale, dy / scale),
    zoom,
    reset,
    click: (at) =>
      pick?.(
        centre.x + (at.x - size.width / 2) / scale,
        centre.y - (at.y - size.height / 2) / scale,
        1 / scale,
      ),
    keys: {
      ArrowLeft: () => move((-size.width * STEP) / scale, 0),
      ArrowRight: () => move((size.width * STEP) / scale, 0),
      ArrowUp: () => move(0, (size.height * STEP) / scale),
      ArrowDown: () => move(0, (-size.height * STEP) / scale),
      "+": () => zoom(1.25),
      "=": () => zoom(1.25),
      "-": () => zoom(0.8),
      0: reset,
    },
  });

  return {
    canvas,
    redraw,
    reset,
    /** What is shown when all is shown: `{left, right, bottom, top}`, metres. */
    fit(whole) {
      box = whole;
      if (!isOwn) show();
      redraw();
    },
    destroy() {
      cancelAnimationFrame(pending);
      watching.disconnect();
      endTheme();
      canvas.remove();
    },
  };
}

/**
 * Follows the pointers, the wheel and the keys of an element that is looked at.
 *
 * @param {HTMLElement} canvas
 * @param {Object} acts
 * @param {function(number, number, PointerEvent)} acts.drag pixels right and down
 * @param {function(number, {x: number, y: number})} acts.zoom by a factor, about a pixel
 * @param {function()} acts.reset
 * @param {function({x: number, y: number})} [acts.click]
 * @param {Object<string, function(KeyboardEvent)>} acts.keys by name
 */
export function follow(canvas, { drag, zoom, reset, click, keys }) {
  const pointers = new Map();
  let moved = 0;
  const place = ({ offsetX: x, offsetY: y }) => ({ x, y });
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, place(event));
    moved = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before) return;
    const after = place(event);
    const wide = pointers.size === 2 ? spread() : 0;
    pointers.set(event.pointerId, after);
    moved += Math.abs(after.x - before.x) + Math.abs(after.y - before.y);
    if (wide) zoom(spread() / wide, after);
    drag((after.x - before.x) / pointers.size, (after.y - before.y) / pointers.size, event);
  });
  const leave = (event) => pointers.delete(event.pointerId);
  canvas.addEventListener("pointerup", (event) => {
    if (pointers.size === 1 && moved < CLICK && event.button === 0) click?.(place(event));
    leave(event);
  });
  canvas.addEventListener("pointercancel", leave);
  canvas.addEventListener("dblclick", reset);
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      const lines = event.deltaMode ? 30 : 1;
      zoom(Math.exp(-0.0015 * lines * event.deltaY), place(event));
    },
    { passive: false },
  );
  canvas.addEventListener("keydown", (event) => {
    const act = event.ctrlKey || event.metaKey || event.altKey ? null : keys[event.key];
    if (!act) return;
    // The page has other uses for these keys.
    event.preventDefault();
    event.stopPropagation();
    act(event);
  });
}

function bounded(scale) {
  return Math.min(Math.max(scale, LEAST_SCALE), MAX_SCALE);
}

function paintGrid(context, view, centre) {
  const step = niceStep(GRID_PIXELS / view.scale);
  const [left, right] = [0, view.width].map((x) => centre.x + (x - view.width / 2) / view.scale);
  const [top, bottom] = [0, view.height].map((y) => centre.y - (y - view.height / 2) / view.scale);
  context.font = "11px system-ui, 'DejaVu Sans', sans-serif";
  const line = (x1, y1, x2, y2, colour) => {
    context.strokeStyle = colour;
    context.beginPath();
    context.moveTo(x1, y1);
    context.lineTo(x2, y2);
    context.stroke();
  };
  context.lineWidth = 1;
  context.fillStyle = view.theme.faint;
  const crisp = (pixel) => Math.round(pixel) + 0.5;
  for (let n = Math.ceil(left / step); n * step <= right; n += 1) {
    const x = crisp(view.x(n * step));
    line(x, 0, x, view.height, n ? view.theme.line : view.theme.faint);
    if (x > 40) context.fillText(metres(n * step), x + 3, view.height - 4);
  }
  for (let n = Math.ceil(bottom / step); n * step <= top; n += 1) {
    const y = crisp(view.y(n * step));
    line(0, y, view.width, y, n ? view.theme.line : view.theme.faint);
    if (y < view.height - 20) context.fillText(metres(n * step), 3, y - 3);
  }
}
