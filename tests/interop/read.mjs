// Prints the messages and schemas of an MCAP file as one JSON document, by the readers of @mcap/core.
import { open } from "node:fs/promises";
import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";

const reader = await McapIndexedReader.Initialize({
  readable: new FileHandleReadable(await open(process.argv[2], "r")),
  decompressHandlers: await loadDecompressHandlers(),
});
const messages = [];
for await (const message of reader.readMessages({ validateCrcs: true })) {
  const { topic } = reader.channelsById.get(message.channelId);
  const payload = Buffer.from(message.data).toString("base64");
  messages.push([topic, message.sequence, String(message.logTime), payload]);
}
const schemas = [...reader.schemasById.values()].map((schema) => [
  schema.name,
  schema.encoding,
  new TextDecoder().decode(schema.data),
]);
console.log(JSON.stringify({ messages, schemas }));
