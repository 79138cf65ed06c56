/** The picture of an image message. */

import { request } from "../api.js";
import { element, fill } from "../dom.js";
import { offset, size } from "../words.js";
import { follow } from "./follow.js";
import { moment, opening } from "./python.js";
import { ofTypes } from "./types.js";

const accepts = ofTypes(
  "sensor_msgs/Image",
  "sensor_msgs/CompressedImage",
  "foxglove_msgs/CompressedImage",
  "foxglove_msgs/CompressedVideo",
  "foxglove_msgs/RawImage",
  "foxglove.CompressedImage",
  "foxglove.CompressedVideo",
  "foxglove.RawImage",
);

export default {
  kind: "image",
  title: "Image",
  isFirst: () => true,
  accepts,
  mount,
  python: (panel) =>
    [
      opening(panel),
      `message = query.at(${moment(panel.recording, panel.cursor())})`,
      "image = message.to_numpy()",
      "print(image.shape, image.dtype)",
    ].join("\n"),
};

function mount(body, panel) {
  const facts = element("p", { class: "facts" }, " ");
  const place = element("div", { class: "picture" });
  body.append(place, facts);
  const asked = { recording: panel.recording.info.id, topic: panel.topic.topic };

  const following = follow({
    load,
    show,
    fail: (error) => problem(error.message),
    panel,
  });

  /** The picture, decoded already, so that it takes the place of another one at once. */
  async function load(at, signal) {
    const response = await request("image", { ...asked, at, seq: panel.seq() }, { signal });
    const time = response.headers.get("Hybridlog-Time");
    const until = response.headers.get("Hybridlog-Until");
    const type = response.headers.get("Content-Type");
    if (type === "application/json") return { time, until, ...(await response.json()) };
    const data = await response.blob();
    const found = { time, until, size: data.size, data, type };
    found.image = await decoded(data);
    if (!found.image) found.problem = `The browser cannot show ${type}.`;
    return found;
  }

  function show(found) {
    if (found.time === null) return problem("No image at or before the cursor.", false);
    const title = `${panel.topic.topic} at ${offset(found.time)}`;
    if (found.problem) problem(found.problem);
    else {
      found.image.alt = title;
      fill(place, found.image);
    }
    const shape = found.image ? `${found.image.naturalWidth} × ${found.image.naturalHeight}` : null;
    const parts = [offset(found.time, 6), shape, found.type, found.size && size(found.size)];
    facts.textContent = parts.filter(Boolean).join(" · ");
    return undefined;
  }

  function problem(text, isProblem = true) {
    facts.textContent = " ";
    fill(place, element("pre", isProblem ? { class: "problem", role: "alert" } : { class: "note" }, text));
  }

  following.want(panel.cursor());
  return {
    update: () => following.want(panel.cursor()),
    destroy: () => following.destroy(),
  };
}

async function decoded(data) {
  const image = new Image();
  image.src = URL.createObjectURL(data);
  try {
    await image.decode();
    return image;
  } catch {
    return null;
  } finally {
    URL.revokeObjectURL(image.src);
  }
}
