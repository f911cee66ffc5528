// Follows the face of a session from Node 18 or newer: npm install zeromq @msgpack/msgpack
//
// usage: node follow.mjs [SESSION [CONTROL-ADDRESS]]
// (default: the newest session, tcp://127.0.0.1:5550)
//
// Prints a line per frame, 50 per second: the time of its sound and the opening of the jaw, one of
// ARKit's 52 weights. It waits for a session, follows it to other hosts, and ends with the session.
// proto/PROTOCOL.md describes all messages and lists the names of the weights.

import { readFile } from "node:fs/promises";
import { homedir } from "node:os";
import { join } from "node:path";
import { setTimeout as sleep } from "node:timers/promises";
import { decode, encode } from "@msgpack/msgpack";
import { Dealer, Subscriber } from "zeromq";

const JAW_OPEN = 24; // index in ARKit's names
const [wanted = "", controlAddress = "tcp://127.0.0.1:5550"] = process.argv.slice(2);
const state = process.env.XDG_STATE_HOME || join(homedir(), ".local", "state");
const keyFile = join(state, "kouxing", "client.key");
const key = JSON.parse(await readFile(keyFile, "utf8").catch(() => {
  fail(`${keyFile} does not exist; start kouxing, or copy the file from its machine`);
}));
process.stdout.on("error", () => process.exit()); // its reader has ended, such as `head`

let numRequests = 0;

/** Print a message and exit. */
function fail(text) {
  console.error(text);
  process.exit(1);
}

/** Connect to an endpoint: an address and the server's public key. */
function connect(Kind, endpoint) {
  const [address, curveServerKey] = endpoint.split(" ");
  const socket = new Kind({ curveServerKey, curvePublicKey: key.public, curveSecretKey: key.secret });
  try {
    socket.connect(address);
  } catch (error) {
    fail(`${address}: ${error.message}; an address looks like tcp://127.0.0.1:5550`);
  }
  return socket;
}

/** Return the kind and the fields of a message. */
function read([topic, body]) {
  return [topic.toString().split("/")[0], decode(body)];
}

/** Send a request; return the fields of the answer. */
async function ask(control, kind, session, fields = {}) {
  const body = { version: 3, session, request: String(++numRequests), ...fields };
  await control.send([`${kind}/${session}/`, encode(body)]);
  return read(await control.receive().catch(() => {
    fail(`control does not answer at ${controlAddress}; start it with: kouxing run`);
  }))[1];
}

/** Return whether a frame is newer than another. After a move some frames arrive twice. */
function isAfter(one, other) {
  return one.media_time > other.media_time
    || (one.media_time === other.media_time && one.sequence > other.sequence);
}

/** Wait for the wanted session, or for any session; return it or the newest. */
async function find(control) {
  for (;;) {
    const { sessions = [] } = await ask(control, "status-request", wanted); // an error has no sessions
    const open = sessions.filter(({ endpoints }) => "faps" in endpoints);
    if (open.length > 0) return open.reduce((a, b) => (a.age_s < b.age_s ? a : b));
    await sleep(500);
  }
}

/** Print a session's frames from one publisher until they end. */
async function follow(endpoint) {
  const face = connect(Subscriber, endpoint);
  for (const kind of ["fap-frame", "end-of-faps", "joined"]) { // joined last: no frame is missed
    face.subscribe(`${kind}/${session}/`);
  }
  for await (const message of face) {
    const [kind, body] = read(message);
    if (kind === "end-of-faps" && body.epoch >= epoch) process.exit();
    if (kind === "joined" && newest.media_time < 0) {
      await ask(control, "set-face", session, { face: { shapes: ["arkit"] } });
      console.log("following", session);
      face.unsubscribe(`joined/${session}/`); // it arrives for every subscriber that joins
    } else if (body.shapes?.arkit && isAfter(body, newest)) {
      newest = body;
      const weights = new Float32Array(new Uint8Array(body.shapes.arkit).buffer); // 52
      console.log((body.media_time / 16000).toFixed(3), weights[JAW_OPEN].toFixed(2));
    }
  }
}

const control = connect(Dealer, `${controlAddress} ${key.control}`);
control.receiveTimeout = 15_000; // ms
const { session, endpoints } = await find(control);
const { services } = await ask(control, "status-request", "");
const { events } = services.find(({ service }) => service === "control").endpoints;
const moves = connect(Subscriber, events); // control publishes there when the session moves
moves.subscribe(`session-moved/${session}/`);

let epoch = 0;
let newest = { media_time: -1, sequence: 0 };
let publisher = endpoints.faps;
follow(publisher);
for await (const message of moves) {
  const [, moved] = read(message);
  ({ epoch } = moved);
  if (moved.faps !== publisher) follow(publisher = moved.faps);
}
