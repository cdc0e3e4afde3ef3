// Decodes and encodes CDR with Foxglove's codec, for lines of JSON on stdin.
import { createRequire } from "node:module";
import { createInterface } from "node:readline";

const require = createRequire(`${process.argv[2]}/`);
const { parse } = require("@foxglove/rosmsg");
const { MessageReader, MessageWriter } = require("@foxglove/rosmsg2-serialization");

const plain = (_, value) => {
  if (typeof value === "bigint") return Number(value);
  return ArrayBuffer.isView(value) ? Array.from(value, Number) : value;
};

for await (const line of createInterface({ input: process.stdin })) {
  const { definition, payload } = JSON.parse(line);
  const types = parse(definition, { ros2: true });
  const message = new MessageReader(types).readMessage(Buffer.from(payload, "hex"));
  const written = Buffer.from(new MessageWriter(types).writeMessage(message)).toString("hex");
  console.log(JSON.stringify({ message, written }, plain));
}
