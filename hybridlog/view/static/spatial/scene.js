/** Points in space, drawn with WebGL; loaded only when there are such points. */

import {
  BufferAttribute,
  BufferGeometry,
  Color,
  ColorManagement,
  LineBasicMaterial,
  LineSegments,
  LinearSRGBColorSpace,
  PerspectiveCamera,
  Points,
  PointsMaterial,
  Scene,
  WebGLRenderer,
} from "../vendor/three.module.min.js";
import { element } from "../dom.js";
import { Colours } from "../paint.js";
import { onTheme } from "./colours.js";
import { follow, niceStep } from "./plane.js";

// Colours are drawn as they are given, as on the rest of the page.
ColorManagement.enabled = false;

const ANGLE = 50; // degrees from the bottom of the picture to its top
const TURN = 0.008; // radians a pixel
const KEY_TURN = 0.15; // radians
const LINES = 20; // of the grid, each way
const START = { azimuth: -2.3, height: 0.55 }; // from behind, to the right and above

/**
 * Puts a scene into an element.
 *
 * @param {HTMLElement} parent
 * @param {{label: string, lost: function()}} parts `lost` is called if WebGL ends
 * @throws {Error} this browser has no WebGL
 */
export function scene(parent, { label, lost }) {
  const canvas = element("canvas", {
    class: "scene",
    tabindex: 0,
    role: "img",
    "aria-label":
      `${label}. Arrow keys turn it, with Shift they move it, plus and minus zoom, 0 shows all, ` +
      "T looks from above.",
  });
  const context = canvas.getContext("webgl2", { antialias: true });
  if (!context) throw new Error("This browser has no WebGL");
  const renderer = new WebGLRenderer({ canvas, context });
  parent.append(canvas);
  renderer.outputColorSpace = LinearSRGBColorSpace;
  renderer.setPixelRatio(devicePixelRatio);
  const world = new Scene();
  const camera = new PerspectiveCamera(ANGLE, 1, 0.01, 1e5);
  camera.up.set(0, 0, 1);
  const cloud = new Points(
    new BufferGeometry(),
    new PointsMaterial({ sizeAttenuation: false, vertexColors: true }),
  );
  cloud.frustumCulled = false;
  const grid = new LineSegments(new BufferGeometry(), new LineBasicMaterial());
  world.add(grid, cloud);

  const paints = new Colours(parent);
  let eye = { ...START, distance: 10, target: [0, 0, 0] };
  let whole = { centre: [0, 0, 0], radius: 5, floor: 0 };
  let isOwn = false;
  let pending = 0;
  let step = 1;

  let isGone = false;
  canvas.addEventListener("webglcontextlost", () => isGone || lost());

  const watching = new ResizeObserver(() => {
    const { width, height } = parent.getBoundingClientRect();
    if (!width || !height) return;
    renderer.setSize(width, height, false);
    camera.aspect = width / height;
    draw();
  });
  watching.observe(parent);
  const endTheme = onTheme(paint);
  paint();

  function paint() {
    paints.forget();
    const theme = paints.all();
    world.background = new Color(theme.raised);
    grid.material.color = new Color(theme.line);
    redraw();
  }

  function redraw() {
    pending ||= requestAnimationFrame(draw);
  }

  function draw() {
    cancelAnimationFrame(pending);
    pending = 0;
    const { azimuth, height, distance, target } = eye;
    const flat = Math.cos(height) * distance;
    camera.position.set(
      target[0] + flat * Math.cos(azimuth),
      target[1] + flat * Math.sin(azimuth),
      target[2] + distance * Math.sin(height),
    );
    camera.near = distance / 1000;
    camera.far = distance * 100 + whole.radius * 10;
    camera.lookAt(...target);
    camera.updateProjectionMatrix();
    renderer.render(world, camera);
    canvas.dataset.view = [azimuth, height, distance, ...target]
      .map((number) => number.toPrecision(5))
      .join(" ");
  }

  function turn(left, up) {
    isOwn = true;
    const height = Math.min(Math.max(eye.height + up, -Math.PI / 2 + 1e-3), Math.PI / 2 - 1e-3);
    eye = { ...eye, azimuth: eye.azimuth + left, height };
    redraw();
  }

  /** Moves the view along the picture, by parts of its height. */
  function move(right, up) {
    isOwn = true;
    const length = eye.distance * 2 * Math.tan((ANGLE * Math.PI) / 360);
    const [x, y] = [-Math.sin(eye.azimuth), Math.cos(eye.azimuth)];
    const tilt = Math.sin(eye.height);
    const forward = [-Math.cos(eye.azimuth) * tilt, -Math.sin(eye.azimuth) * tilt, Math.cos(eye.height)];
    const target = eye.target.map(
      (value, at) => value + length * (right * [x, y, 0][at] + up * forward[at]),
    );
    eye = { ...eye, target };
    redraw();
  }

  function zoom(factor) {
    isOwn = true;
    const distance = Math.min(Math.max(eye.distance / factor, whole.radius / 1e4), whole.radius * 1e3);
    eye = { ...eye, distance };
    redraw();
  }

  function reset() {
    isOwn = false;
    eye = { ...START, ...fitted() };
    redraw();
  }

  function fromAbove() {
    isOwn = true;
    eye = { azimuth: -Math.PI / 2, height: Math.PI / 2 - 1e-3, ...fitted() };
    redraw();
  }

  function fitted() {
    const narrow = Math.min(camera.aspect, 1);
    const distance = (whole.radius / Math.tan((ANGLE * Math.PI) / 360) / narrow) * 1.05;
    return { distance, target: [...whole.centre] };
  }

  follow(canvas, {
    drag(dx, dy, event) {
      const moves = event.shiftKey || event.buttons & 6;
      const { height } = canvas.getBoundingClientRect();
      if (moves) move(-dx / height, dy / height);
      else turn(-dx * TURN, dy * TURN);
    },
    zoom,
    reset,
    keys: {
      ArrowLeft: (event) => (event.shiftKey ? move(-0.1, 0) : turn(-KEY_TURN, 0)),
      ArrowRight: (event) => (event.shiftKey ? move(0.1, 0) : turn(KEY_TURN, 0)),
      ArrowUp: (event) => (event.shiftKey ? move(0, 0.1) : turn(0, KEY_TURN)),
      ArrowDown: (event) => (event.shiftKey ? move(0, -0.1) : turn(0, -KEY_TURN)),
      "+": () => zoom(1.25),
      "=": () => zoom(1.25),
      "-": () => zoom(0.8),
      0: reset,
      t: fromAbove,
      T: fromAbove,
    },
  });

  function drawGrid() {
    const { centre, radius, floor } = whole;
    step = niceStep((2 * radius) / LINES);
    const reach = Math.ceil(radius / step) * step;
    const [x, y] = centre.map((value) => Math.round(value / step) * step);
    const places = [];
    for (let by = -reach; by <= reach + step / 2; by += step) {
      places.push(x + by, y - reach, floor, x + by, y + reach, floor);
      places.push(x - reach, y + by, floor, x + reach, y + by, floor);
    }
    setPlaces(grid, new Float32Array(places));
  }

  return {
    isFlat: false,
    reset,
    /** Length of a square of the grid, metres. */
    get step() {
      return step;
    },
    /** Draws these in the place of others: x, y and z of each, red, green and blue, and size. */
    show(xyz, colours, pixels) {
      cloud.material.size = pixels * devicePixelRatio;
      setPlaces(cloud, xyz);
      cloud.geometry.setAttribute("color", new BufferAttribute(colours, 3, true));
      redraw();
    },
    /** What is shown when all is shown. */
    fit({ left, right, bottom, top, low, high }) {
      const centre = [(left + right) / 2, (bottom + top) / 2, (low + high) / 2];
      const radius = Math.hypot(right - left, top - bottom, high - low) / 2 || 1;
      whole = { centre, radius, floor: low };
      drawGrid();
      if (!isOwn) reset();
      else redraw();
    },
    destroy() {
      isGone = true;
      cancelAnimationFrame(pending);
      watching.disconnect();
      endTheme();
      for (const { geometry, material } of [cloud, grid]) {
        geometry.dispose();
        material.dispose();
      }
      renderer.dispose();
      // Browsers allow few of them at a time.
      renderer.forceContextLoss();
      canvas.remove();
    },
  };
}

/** New places; their number may differ from before, so the buffers on the card are new, too. */
function setPlaces(drawn, xyz) {
  drawn.geometry.dispose();
  drawn.geometry = new BufferGeometry();
  drawn.geometry.setAttribute("position", new BufferAttribute(xyz, 3));
}
