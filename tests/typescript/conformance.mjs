// Writes the conformance set of MCAP: every kind of record in every combination of the format's
// optional parts. After tests/conformance/scripts/generate-inputs.ts of github.com/foxglove/mcap
// (MIT, Copyright (c) Foxglove Technologies Inc), whose files are not in its npm packages.
//
//   node conformance.mjs FOLDER

import { mkdirSync, writeFileSync } from "node:fs";
import { join } from "node:path";

import { crc32 } from "@foxglove/crc";
import { McapChunkBuilder, McapRecordBuilder, Opcode } from "@mcap/core";

const data = new Uint8Array([1, 2, 3]);
const schema = { type: "Schema", id: 1, name: "Example", encoding: "c", data: new Uint8Array([4, 5, 6]) };
const channel = { type: "Channel", id: 1, topic: "example", schemaId: 1, messageEncoding: "a", metadata: new Map([["foo", "bar"]]) };
const schemaless = { ...channel, schemaId: 0, messageEncoding: "text", metadata: new Map() };
const message = { type: "Message", channelId: 1, publishTime: 1n, logTime: 2n, data, sequence: 10 };
const messages = [0n, 2n, 1n, 3n, 3n, 5n, 4n, 7n, 8n, 9n].map((time, sequence) => ({ ...message, publishTime: time, logTime: time, sequence }));
const attachment = { type: "Attachment", name: "myFile", mediaType: "application/octet-stream", logTime: 2n, createTime: 1n, data };
const metadata = { type: "Metadata", name: "myMetadata", metadata: new Map([["foo", "bar"]]) };
const contents = {
  NoData: [],
  OneSchemalessMessage: [schemaless, message],
  OneMessage: [schema, channel, message],
  OneAttachment: [attachment],
  OneMetadata: [metadata],
  TenMessages: [schema, channel, ...messages],
};

function* combinations(features) {
  if (features.length === 0) {
    yield new Set();
    return;
  }
  for (const others of combinations(features.slice(1))) {
    yield others;
    yield new Set([features[0], ...others]);
  }
}

// Whether what is optional can be in a file of these records.
function fits(parts, records) {
  const holds = (...types) => records.some((record) => types.includes(record.type));
  if (parts.has("ax") && !holds("Attachment")) return false;
  if (parts.has("mdx") && !holds("Metadata")) return false;
  if (parts.has("rsh") && !holds("Schema")) return false;
  if (parts.has("rch") && !holds("Channel")) return false;
  if (["ch", "chx", "mx"].some((part) => parts.has(part)) && !holds("Message", "Channel", "Schema")) return false;
  if (parts.has("sum") && !["chx", "rsh", "rch", "mdx", "ax", "st"].some((part) => parts.has(part))) return false;
  return parts.has("ch") || !(parts.has("chx") || parts.has("mx"));
}

function writeChunk(builder, records, parts) {
  const chunk = new McapChunkBuilder({ useMessageIndex: parts.has("mx") });
  for (const record of records) {
    if (record.type === "Schema") chunk.addSchema(record);
    if (record.type === "Channel") chunk.addChannel(record);
    if (record.type === "Message") chunk.addMessage(record);
  }
  const uncompressedSize = BigInt(chunk.buffer.byteLength);
  const times = { messageStartTime: chunk.messageStartTime, messageEndTime: chunk.messageEndTime };
  const chunkStartOffset = BigInt(builder.length);
  const chunkLength = builder.writeChunk({ ...times, compression: "", uncompressedCrc: crc32(chunk.buffer), uncompressedSize, records: chunk.buffer });
  const messageIndexOffsets = new Map();
  let messageIndexLength = 0n;
  for (const index of chunk.indices) {
    messageIndexOffsets.set(index.channelId, BigInt(builder.length));
    messageIndexLength += builder.writeMessageIndex(index);
  }
  return { ...times, compression: "", uncompressedSize, compressedSize: uncompressedSize, chunkStartOffset, chunkLength, messageIndexLength, messageIndexOffsets };
}

function statisticsOf(records, parts) {
  const count = (type) => records.filter((record) => record.type === type).length;
  const times = records.filter((record) => record.type === "Message").map((record) => record.logTime);
  const ascending = times.sort((a, b) => Number(a - b));
  const messageCount = BigInt(times.length);
  return {
    messageCount,
    channelCount: count("Channel"),
    schemaCount: count("Schema"),
    attachmentCount: count("Attachment"),
    metadataCount: count("Metadata"),
    chunkCount: parts.has("ch") ? 1 : 0,
    messageStartTime: ascending[0] ?? 0n,
    messageEndTime: ascending.at(-1) ?? 0n,
    channelMessageCounts: new Map(times.length ? [[1, messageCount]] : []),
  };
}

function fileOf(records, parts) {
  const builder = new McapRecordBuilder({ padRecords: parts.has("pad") });
  builder.writeMagic();
  builder.writeHeader({ profile: "", library: "" });
  const metadataIndexes = [];
  const attachmentIndexes = [];
  for (const record of records) {
    const offset = BigInt(builder.length);
    if (record.type === "Attachment") {
      const { name, mediaType, logTime, createTime } = record;
      const length = builder.writeAttachment(record);
      attachmentIndexes.push({ name, mediaType, logTime, createTime, offset, length, dataSize: BigInt(record.data.byteLength) });
    } else if (record.type === "Metadata") {
      metadataIndexes.push({ name: record.name, offset, length: builder.writeMetadata(record) });
    } else if (!parts.has("ch")) {
      builder[`write${record.type}`](record);
    }
  }
  const chunkIndexes = parts.has("ch") ? [writeChunk(builder, records, parts)] : [];
  builder.writeDataEnd({ dataSectionCrc: crc32(builder.buffer) });

  const start = BigInt(builder.length);
  const groups = [];
  const group = (wanted, opcode, write) => {
    const groupStart = BigInt(builder.length);
    if (wanted) write();
    const groupLength = BigInt(builder.length) - groupStart;
    if (groupLength) groups.push({ groupOpcode: opcode, groupStart, groupLength });
  };
  const repeat = (type) => () => {
    for (const record of records.filter((one) => one.type === type)) builder[`write${type}`](record);
  };
  group(parts.has("rsh"), Opcode.SCHEMA, repeat("Schema"));
  group(parts.has("rch"), Opcode.CHANNEL, repeat("Channel"));
  group(parts.has("st"), Opcode.STATISTICS, () => builder.writeStatistics(statisticsOf(records, parts)));
  group(parts.has("mdx"), Opcode.METADATA_INDEX, () => metadataIndexes.forEach((index) => builder.writeMetadataIndex(index)));
  group(parts.has("ax"), Opcode.ATTACHMENT_INDEX, () => attachmentIndexes.forEach((index) => builder.writeAttachmentIndex(index)));
  group(parts.has("chx"), Opcode.CHUNK_INDEX, () => chunkIndexes.forEach((index) => builder.writeChunkIndex(index)));
  const summaryStart = groups.length ? start : 0n;
  const summaryOffsetStart = parts.has("sum") ? BigInt(builder.length) : 0n;
  if (parts.has("sum")) groups.forEach((one) => builder.writeSummaryOffset(one));

  const summary = builder.buffer.slice(Number(start));
  const footer = new McapRecordBuilder();
  footer.writeFooter({ summaryStart, summaryOffsetStart, summaryCrc: 0 });
  const summaryCrc = crc32(Buffer.concat([summary, footer.buffer.slice(0, 25)]));
  builder.writeFooter({ summaryStart, summaryOffsetStart, summaryCrc });
  builder.writeMagic();
  return builder.buffer;
}

const parts = ["ch", "mx", "st", "rsh", "rch", "ax", "mdx", "chx", "sum", "pad"];
mkdirSync(process.argv[2], { recursive: true });
for (const [name, records] of Object.entries(contents)) {
  for (const chosen of combinations(parts)) {
    if (!fits(chosen, records)) continue;
    const path = join(process.argv[2], `${[name, ...[...chosen].sort()].join("-")}.mcap`);
    writeFileSync(path, fileOf(records, chosen));
  }
}
