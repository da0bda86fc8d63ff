// Decodes every message of the MCAP files named, one file after the other, and prints, as JSON, what
// came of each topic:
//
//   count      messages
//   sha256     of all that is in them and of their log times; test_bag_files.py says how it is laid out
//   positions  sum of all `position` arrays, in the order of the messages
//   stamps     sum of all stamps, ns, as a string
//
// Anything that is not as the schema or a CRC in the file says ends this with an error.

import { createHash } from "node:crypto";
import { open } from "node:fs/promises";

import rosmsg from "@foxglove/rosmsg";
import serialization from "@foxglove/rosmsg2-serialization";
import { McapIndexedReader } from "@mcap/core";
import { decompress } from "fzstd";

const GIGA = 1_000_000_000n;

function number(value) {
  const exact = Number(value); // of a bigint too
  if (typeof value === "bigint" && BigInt(exact) !== value) {
    throw new Error(`${value} is no double`);
  }
  return exact;
}

// Lay a value out as bytes: numbers as doubles, lengths before strings and arrays, fields in order.
function* lay(value) {
  if (typeof value === "string") {
    const text = Buffer.from(value, "utf8");
    yield* lay(text.length);
    yield text;
  } else if (typeof value === "object" && value[Symbol.iterator] == undefined) {
    for (const field of Object.values(value)) {
      yield* lay(field);
    }
  } else if (Array.isArray(value) && ["object", "string"].includes(typeof value[0])) {
    yield* lay(value.length);
    for (const each of value) {
      yield* lay(each);
    }
  } else if (typeof value === "object") {
    yield* lay(value.length); // numbers: an array, or a typed one
    const data = Buffer.alloc(8 * value.length);
    value.forEach((each, n) => data.writeDoubleLE(number(each), 8 * n));
    yield data;
  } else {
    const data = Buffer.alloc(8);
    data.writeDoubleLE(number(value));
    yield data;
  }
}

class Topic {
  constructor() {
    this.count = 0;
    this.hash = createHash("sha256");
    this.positions = 0;
    this.stamps = 0n;
  }

  add(logTime, message) {
    this.count += 1;
    const time = Buffer.alloc(8);
    time.writeBigUInt64LE(logTime);
    this.hash.update(time);
    for (const part of lay(message)) {
      this.hash.update(part);
    }
    for (const position of message.position ?? []) {
      this.positions += position;
    }
    const stamp = message.header?.stamp ?? message.clock;
    if (stamp != undefined) {
      this.stamps += BigInt(stamp.sec) * GIGA + BigInt(stamp.nanosec);
    }
  }

  toJSON() {
    return {
      count: this.count,
      sha256: this.hash.digest("hex"),
      positions: this.positions,
      stamps: String(this.stamps),
    };
  }
}

async function read(path, topics) {
  const file = await open(path, "r");
  try {
    const readable = {
      async size() {
        return BigInt((await file.stat()).size);
      },
      async read(offset, length) {
        const data = new Uint8Array(Number(length));
        const { bytesRead } = await file.read(data, 0, data.length, Number(offset));
        if (bytesRead !== data.length) {
          throw new Error(`${path}: ${bytesRead} bytes instead of ${length} at ${offset}`);
        }
        return data;
      },
    };
    const reader = await McapIndexedReader.Initialize({
      readable,
      decompressHandlers: {
        zstd: (data, size) => decompress(data, new Uint8Array(Number(size))),
      },
    });
    const decoders = new Map();
    for (const { id, schemaId, messageEncoding } of reader.channelsById.values()) {
      const schema = reader.schemasById.get(schemaId);
      if (messageEncoding !== "cdr" || schema.encoding !== "ros2msg") {
        throw new Error(`${path}: ${messageEncoding}, ${schema.encoding}`);
      }
      const text = new TextDecoder("utf-8", { fatal: true }).decode(schema.data);
      decoders.set(
        id,
        new serialization.MessageReader(rosmsg.parse(text, { ros2: true })),
      );
    }
    let count = 0n;
    for await (const message of reader.readMessages({ validateCrcs: true })) {
      const { topic } = reader.channelsById.get(message.channelId);
      const decoder = decoders.get(message.channelId);
      const decoded = decoder.readMessage(message.data);
      if (decoder.lastReadHadTrailingBytes()) {
        throw new Error(`${path}: ${topic} has more bytes than its schema says`);
      }
      if (!topics.has(topic)) {
        topics.set(topic, new Topic());
      }
      topics.get(topic).add(message.logTime, decoded);
      count += 1n;
    }
    if (count !== reader.statistics?.messageCount) {
      throw new Error(`${path}: ${count} messages, ${reader.statistics?.messageCount} promised`);
    }
  } finally {
    await file.close();
  }
}

const topics = new Map();
for (const path of process.argv.slice(2)) {
  await read(path, topics);
}
console.log(JSON.stringify(Object.fromEntries(topics)));
