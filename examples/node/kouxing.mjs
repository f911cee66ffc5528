// Connections and messages of kouxing's protocol, for follow.mjs and stream.mjs.
// Needs Node 18 or newer, and the packages that npm ci installs from package.json.

import { randomBytes } from "node:crypto";
import { readFile } from "node:fs/promises";
import { homedir } from "node:os";
import { join } from "node:path";
import { decode, encode } from "@msgpack/msgpack";
import { Dealer, Subscriber } from "zeromq";

const state = process.env.XDG_STATE_HOME || join(homedir(), ".local", "state");
const keyFile = join(state, "kouxing", "client.key");
const key = JSON.parse(await readFile(keyFile, "utf8").catch(() => {
  fail(`${keyFile} does not exist; start kouxing, or copy the file from its machine`);
}));
process.stdout.on("error", () => process.exit()); // the reader of the output, such as `head`, has ended
let controlAddress = "";
let numRequests = 0;

/** Print a message and exit. */
export function fail(text) {
  console.error(text);
  process.exit(1);
}

/** Connect to an endpoint: an address and the server's public key. */
function connect(Kind, endpoint) {
  const [address, curveServerKey] = endpoint.split(" ");
  const socket = new Kind({ curveServerKey, curvePublicKey: key.public, curveSecretKey: key.secret });
  if (Kind === Dealer) socket.routingId = randomBytes(16).toString("hex");
  try {
    socket.connect(address);
  } catch (error) {
    fail(`${address}: ${error.message}; an address looks like tcp://127.0.0.1:5550`);
  }
  return socket;
}

export const connectDealer = (endpoint) => connect(Dealer, endpoint);

/** Connect to control, which answers requests. Without an address, use $KOUXING_CONTROL. */
export function connectControl(address) {
  controlAddress = address || process.env.KOUXING_CONTROL || "tcp://127.0.0.1:5550";
  const control = connect(Dealer, `${controlAddress} ${key.control}`);
  control.receiveTimeout = 15_000; // ms
  return control;
}

/** Subscribe to some kinds of messages of a session. */
export function subscribe(endpoint, session, kinds) {
  const subscriber = connect(Subscriber, endpoint);
  for (const kind of kinds) subscriber.subscribe(`${kind}/${session}/`);
  return subscriber;
}

/** Send a message. */
export function send(socket, kind, session, fields) {
  return socket.send([`${kind}/${session}/`, encode({ version: 3, session, ...fields })]);
}

/** Return the kind and the fields of a message. */
export function read([topic, body]) {
  return [topic.toString().split("/")[0], decode(body)];
}

/** Send a request to control; return the kind and the fields of the answer. */
export async function ask(control, kind, session, fields = {}) {
  await send(control, kind, session, { request: String(++numRequests), ...fields });
  return read(await control.receive().catch(() => {
    fail(`control at ${controlAddress} does not answer; start it with: kouxing run`);
  }));
}
