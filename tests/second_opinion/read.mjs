// Reads segments with the MCAP reader for JavaScript, in its two ways, checksums checked.
//
//   node read.mjs FILE...
//
// prints a JSON array with one object a file: what the streaming reader has seen, what the
// indexed one has, and what the file says of itself. A file that either refuses ends it all.

import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { decompress as zstd } from "fzstd";
import lz4 from "lz4js";
import { createHash } from "node:crypto";
import { open } from "node:fs/promises";

const PIECE = 1 << 20;
// Both work on views of one large buffer, which is why what they give is copied.
const decompressHandlers = {
  zstd: (data, size) => zstd(data, new Uint8Array(Number(size))),
  lz4: (data, size) => new Uint8Array(lz4.decompress(data, Number(size))),
};

/** Counts messages, and digests them in an order that does not depend on the reader's. */
class Tally {
  #digests = [];
  #topics = new Map();

  add(topic, message) {
    const hash = createHash("sha256");
    hash.update(`${topic}\0${message.logTime}\0${message.publishTime}\0${message.sequence}\0`);
    hash.update(message.data);
    this.#digests.push(hash.digest("hex"));
    this.#topics.set(topic, (this.#topics.get(topic) ?? 0) + 1);
  }

  result() {
    const all = createHash("sha256").update(this.#digests.sort().join("")).digest("hex");
    return {
      messages: this.#digests.length,
      topics: Object.fromEntries(this.#topics),
      digest: all,
    };
  }
}

async function* pieces(file) {
  const { size } = await file.stat();
  for (let at = 0; at < size; at += PIECE) {
    const buffer = new Uint8Array(Math.min(PIECE, size - at));
    await file.read(buffer, 0, buffer.length, at);
    yield buffer;
  }
}

async function stream(file) {
  const reader = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  const channels = new Map();
  const tally = new Tally();
  const others = new Map();
  for await (const piece of pieces(file)) {
    reader.append(piece);
    for (let record; (record = reader.nextRecord()); ) {
      if (record.type === "Channel") {
        channels.set(record.id, record);
      } else if (record.type === "Message") {
        tally.add(channels.get(record.channelId).topic, record);
      } else {
        others.set(record.type, (others.get(record.type) ?? 0) + 1);
      }
    }
  }
  if (!reader.done() || reader.bytesRemaining() !== 0) {
    throw new Error("the stream did not come to its end");
  }
  return { ...tally.result(), records: Object.fromEntries(others) };
}

async function indexed(file) {
  const readable = {
    size: async () => BigInt((await file.stat()).size),
    read: async (offset, size) => {
      const buffer = new Uint8Array(Number(size));
      const { bytesRead } = await file.read(buffer, 0, buffer.length, Number(offset));
      if (bytesRead !== buffer.length) {
        throw new Error(`${bytesRead} bytes of ${size} at ${offset}`);
      }
      return buffer;
    },
  };
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  const tally = new Tally();
  const backwards = new Tally();
  let last = -1n;
  let ordered = true;
  for await (const message of reader.readMessages({ validateCrcs: true })) {
    ordered &&= message.logTime >= last;
    last = message.logTime;
    tally.add(reader.channelsById.get(message.channelId).topic, message);
  }
  for await (const message of reader.readMessages({ validateCrcs: true, reverse: true })) {
    backwards.add(reader.channelsById.get(message.channelId).topic, message);
  }
  const metadata = [];
  for await (const record of reader.readMetadata()) {
    metadata.push(record.name);
  }
  let attachments = 0;
  for await (const _ of reader.readAttachments({ validateCrcs: true })) {
    attachments += 1;
  }
  const { statistics } = reader;
  return {
    ...tally.result(),
    ordered,
    backwards: backwards.result().digest,
    profile: reader.header.profile,
    metadata,
    attachments,
    chunks: reader.chunkIndexes.length,
    statistics: {
      messages: Number(statistics.messageCount),
      channels: statistics.channelCount,
      chunks: statistics.chunkCount,
      start: String(statistics.messageStartTime),
      end: String(statistics.messageEndTime),
    },
  };
}

const results = [];
for (const path of process.argv.slice(2)) {
  const file = await open(path, "r");
  try {
    results.push({ path, stream: await stream(file), indexed: await indexed(file) });
  } catch (error) {
    throw new Error(`${path}: ${error.message}`, { cause: error });
  } finally {
    await file.close();
  }
}
process.stdout.write(JSON.stringify(results));
