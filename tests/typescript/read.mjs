// Reads an MCAP file with the official TypeScript libraries and prints what it says as JSON.
//
//   node read.mjs messages FILE   one line a message, in the order of log time, by the index
//   node read.mjs stream FILE     the same in the order of the file, which may be unfinished:
//                                 then the exit status is 3
//   node read.mjs summary FILE    one line about the file: its index, metadata and attachments
//
// JSON has no 64 bits, no NaN, no infinities and no -0: they are strings.

import { createReadStream } from "node:fs";
import { open } from "node:fs/promises";

import rosmsg from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";
import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";

const decompressHandlers = await loadDecompressHandlers();

async function openIndexed(path) {
  const readable = new FileHandleReadable(await open(path));
  return await McapIndexedReader.Initialize({ readable, decompressHandlers });
}

async function* indexedMessages(path) {
  const reader = await openIndexed(path);
  for await (const message of reader.readMessages({ validateCrcs: true })) {
    const channel = reader.channelsById.get(message.channelId);
    yield [reader.schemasById.get(channel.schemaId), channel, message];
  }
}

async function* streamedMessages(path) {
  const reader = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  const schemas = new Map();
  const channels = new Map();
  for await (const bytes of createReadStream(path)) {
    reader.append(bytes);
    for (let record; (record = reader.nextRecord()); ) {
      if (record.type === "Schema") {
        schemas.set(record.id, record);
      } else if (record.type === "Channel") {
        channels.set(record.id, record);
      } else if (record.type === "Message") {
        const channel = channels.get(record.channelId);
        yield [schemas.get(channel.schemaId), channel, record];
      }
    }
  }
  process.exitCode = reader.done() ? 0 : 3;
}

async function* decoded(messages) {
  const readers = new Map();
  for await (const [schema, channel, message] of messages) {
    if (!readers.has(schema.id)) {
      const text = new TextDecoder().decode(schema.data);
      readers.set(schema.id, new MessageReader(rosmsg.parse(text, { ros2: true })));
    }
    const reader = readers.get(schema.id);
    const fields = reader.readMessage(message.data);
    if (reader.lastReadHadTrailingBytes()) {
      throw new Error(`${channel.topic}: more bytes than ${schema.name} has`);
    }
    const { logTime, publishTime, sequence } = message;
    yield { topic: channel.topic, schema: schema.name, logTime, publishTime, sequence, fields };
  }
}

async function* summary(path) {
  const reader = await openIndexed(path);
  const metadata = {};
  for await (const record of reader.readMetadata()) {
    metadata[record.name] = record.metadata;
  }
  const attachments = {};
  for await (const record of reader.readAttachments({ validateCrcs: true })) {
    attachments[record.name] = new TextDecoder().decode(record.data);
  }
  const { header, footer, statistics, chunkIndexes } = reader;
  yield {
    header,
    footer,
    statistics,
    compressions: chunkIndexes.map((chunk) => chunk.compression),
    summaryOffsets: [...reader.summaryOffsetsByOpcode.keys()],
    schemas: [...reader.schemasById.values()].map(({ name, encoding }) => ({ name, encoding })),
    channels: [...reader.channelsById.values()],
    metadata,
    attachments,
  };
}

function printable(_, value) {
  if (Object.is(value, -0)) {
    return "-0";
  }
  if (typeof value === "bigint" || (typeof value === "number" && !Number.isFinite(value))) {
    return String(value);
  }
  if (value instanceof Map) {
    return Object.fromEntries(value);
  }
  return ArrayBuffer.isView(value) ? Array.from(value) : value;
}

const ways = {
  messages: (path) => decoded(indexedMessages(path)),
  stream: (path) => decoded(streamedMessages(path)),
  summary,
};
const [way, path] = process.argv.slice(2);
try {
  for await (const row of ways[way](path)) {
    process.stdout.write(JSON.stringify(row, printable) + "\n");
  }
} catch (error) {
  process.stderr.write(`${path}: ${error.message}\n`);
  process.exitCode = 1;
}
