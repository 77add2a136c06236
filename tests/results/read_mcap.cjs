// Reads an MCAP with the format's own JavaScript packages: every record's CRC, every message by its schema.
// node read_mcap.cjs FILE; prints one JSON object. Packages are found through NODE_PATH.
"use strict";
const fs = require("node:fs/promises");
const { McapIndexedReader, McapStreamReader } = require("@mcap/core");
const { loadDecompressHandlers, protobufFromBinaryDescriptor } = require("@mcap/support");
const { FileHandleReadable } = require("@mcap/nodejs");

(async () => {
  const decompressHandlers = await loadDecompressHandlers();
  const file = await fs.open(process.argv[2]);
  const reader = await McapIndexedReader.Initialize({ readable: new FileHandleReadable(file), decompressHandlers });
  const parsed = new Map(), topics = {};
  for (const channel of reader.channelsById.values()) {
    const schema = reader.schemasById.get(channel.schemaId);
    if (channel.messageEncoding !== "protobuf" || schema.encoding !== "protobuf") throw new Error(schema.encoding);
    parsed.set(channel.id, protobufFromBinaryDescriptor(schema.data).lookupType(schema.name));
    topics[channel.topic] = { schema: schema.name, count: 0, stamps: [], last: null };
  }
  for await (const message of reader.readMessages({ validateCrcs: true })) {
    const topic = topics[reader.channelsById.get(message.channelId).topic];
    const value = parsed.get(message.channelId).decode(message.data);
    topic.count += 1;
    topic.stamps.push(String(message.logTime));
    topic.last = value;
  }
  const metadata = {};
  for await (const record of reader.readMetadata()) metadata[record.name] = Object.fromEntries(record.metadata);
  const attachments = [];
  for await (const one of reader.readAttachments()) attachments.push(one.name);

  const streamed = {};  // once more from the front, which checks the data section's own CRC
  const stream = new McapStreamReader({ validateCrcs: true, decompressHandlers });
  stream.append(new Uint8Array(await fs.readFile(process.argv[2])));
  for (let record; (record = stream.nextRecord()) != undefined; ) streamed[record.type] = (streamed[record.type] ?? 0) + 1;
  const plain = (key, value) => (typeof value === "bigint" ? String(value) : value);
  console.log(JSON.stringify({ topics, metadata, attachments, streamed, done: stream.done() }, plain));
  await file.close();
})();
