/** Python that gets from the store what a panel shows. */

/** A text as Python writes it. JSON's escapes are Python's, too. */
export function literal(text) {
  return JSON.stringify(String(text));
}

/** Lines that open the store and ask about the topic of a panel; `query` is the query. */
export function opening({ recording, topic }) {
  return [
    "import hybridlog",
    "",
    `store = hybridlog.open(${literal(recording.info.store)})`,
    `query = store.topic(${literal(topic.topic)}).in_recording(${literal(recording.info.id)})`,
  ].join("\n");
}

/** A time since the start of the recording, as nanoseconds since 1970. */
export function moment(recording, at) {
  return String(recording.toTime(at));
}
