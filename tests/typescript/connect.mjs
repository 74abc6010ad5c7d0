// Connects to `hearthlog watch --foxglove` with the client that Foxglove uses, and prints what comes
// as JSON, an event a line.
//
//   node connect.mjs URL [HEADERS]   HEADERS of the request besides, as JSON
//
// It subscribes to every channel. A line of JSON on standard input asks for playback: {"play": true,
// "speed": 1, "seek": "1772348400000000000"}; "seek" may be missing. Any other is sent as it is. It ends
// with its input.

import { createInterface } from "node:readline";

import rosmsg from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";
import foxglove from "@foxglove/ws-protocol";
import WebSocket from "ws";

const PROTOCOL = "foxglove.sdk.v1"; // the client is older than this name
const [PLAYBACK_REQUEST, PLAYBACK_STATE] = [3, 5]; // and than playback

function print(event, what) {
  const plain = (_, value) =>
    typeof value === "bigint" || (typeof value === "number" && !Number.isFinite(value))
      ? String(value)
      : ArrayBuffer.isView(value)
        ? Array.from(value)
        : value;
  process.stdout.write(JSON.stringify({ event, ...what }, plain) + "\n");
}

const [url, headers] = process.argv.slice(2);
const socket = new WebSocket(url, [PROTOCOL], { headers: JSON.parse(headers ?? "{}") });
socket.on("unexpected-response", (_, response) => {
  let body = "";
  response.on("data", (part) => (body += part));
  response.on("end", () => {
    print("refused", { status: response.statusCode, headers: response.headers, body });
    process.exit();
  });
});

const client = new foxglove.FoxgloveClient({ ws: socket });
const channels = new Map();
const subscribed = new Map();
client.on("error", (error) => print("error", { message: error.message }));
client.on("close", () => {
  print("close");
  process.exit();
});
client.on("serverInfo", (info) => print("serverInfo", info));
client.on("status", ({ level, message }) => print("status", { level, message }));
client.on("time", ({ timestamp }) => print("time", { timestamp }));
client.on("unadvertise", (ids) => {
  print("unadvertise", { topics: ids.map((id) => channels.get(id).topic) });
});
client.on("advertise", (advertised) => {
  for (const channel of advertised) {
    const { id, topic, encoding, schemaName, schemaEncoding, schema } = channel;
    const reader = new MessageReader(rosmsg.parse(schema, { ros2: true }));
    channels.set(id, channel);
    subscribed.set(client.subscribe(id), { topic, reader });
    print("advertise", { topic, encoding, schemaName, schemaEncoding });
  }
});
client.on("message", ({ subscriptionId, timestamp, data }) => {
  const { topic, reader } = subscribed.get(subscriptionId);
  const fields = reader.readMessage(data);
  if (reader.lastReadHadTrailingBytes()) {
    throw new Error(`${topic}: more bytes than its type has`);
  }
  const bytes = Buffer.from(data.buffer, data.byteOffset, data.byteLength).toString("base64");
  print("message", { topic, logTime: timestamp, received: Date.now() / 1000, bytes, fields });
});

const receive = socket.onmessage;
socket.onmessage = (event) => {
  const view = event.data instanceof ArrayBuffer ? new DataView(event.data) : undefined;
  if (view?.getUint8(0) !== PLAYBACK_STATE) {
    receive(event);
    return;
  }
  const status = ["playing", "paused", "buffering", "ended"][view.getUint8(1)];
  const [time, speed] = [view.getBigUint64(2, true), view.getFloat32(10, true)];
  const id = Buffer.from(event.data, 19, view.getUint32(15, true)).toString();
  print("state", { status, time, speed, sought: view.getUint8(14) === 1, id });
};

let requests = 0;
createInterface({ input: process.stdin })
  .on("line", (line) => {
    const request = JSON.parse(line);
    if (request.op !== undefined) {
      socket.send(line);
      return;
    }
    const { play, speed, seek } = request;
    const id = Buffer.from(`request ${++requests}`);
    const head = Buffer.alloc(19);
    head.writeUInt8(PLAYBACK_REQUEST, 0);
    head.writeUInt8(play ? 0 : 1, 1);
    head.writeFloatLE(speed, 2);
    head.writeUInt8(seek === undefined ? 0 : 1, 6);
    head.writeBigUInt64LE(BigInt(seek ?? 0), 7);
    head.writeUInt32LE(id.length, 15);
    socket.send(Buffer.concat([head, id]));
  })
  .on("close", () => process.exit());
