// Streams a wav file (16 kHz, mono, 16 bits) and prints how far the jaw opens.
//
// usage: node client.mjs FILE.wav    (Node 18 or newer; npm install zeromq @msgpack/msgpack)

import { randomBytes } from "node:crypto";
import { readFile } from "node:fs/promises";
import { homedir } from "node:os";
import { decode, encode } from "@msgpack/msgpack";
import { Dealer, Subscriber } from "zeromq";

const key = JSON.parse(await readFile("~/.local/state/kouxing/client.key".replace("~", homedir())));

function connect(Kind, endpoint) {
  const [address, curveServerKey] = endpoint.split(" ");
  const socket = new Kind({ curveServerKey, curvePublicKey: key.public, curveSecretKey: key.secret });
  if (Kind === Dealer) socket.routingId = randomBytes(16).toString("hex");
  socket.connect(address);
  return socket;
}

function send(socket, kind, session, fields) {
  return socket.send([`${kind}/${session}/`, encode({ version: 3, session, ...fields })]);
}

function read([topic, body]) {
  return [topic.toString().split("/")[0], decode(body)];
}

const control = connect(Dealer, "tcp://127.0.0.1:5550 " + key.control);
await send(control, "open-session", "", { request: "1", paced: false });
const [answer, opened] = read(await control.receive());
if (answer !== "session-opened") throw new Error(opened.text);
const { session, token } = opened;

const faps = connect(Subscriber, opened.faps);
for (const kind of ["fap-frame", "end-of-faps", "joined"]) { // joined last
  faps.subscribe(`${kind}/${session}/`);
}
await faps.receive(); // joined: no later frame is missed

async function speak(wav) {
  const audio = connect(Dealer, opened.audio);
  const samples = wav.subarray(wav.indexOf("data") + 8);
  let sequence = 1;
  let media_time = 0;
  for (; media_time < samples.length / 2; media_time += 320) { // 20 ms
    const pcm = samples.subarray(2 * media_time, 2 * media_time + 640);
    await send(audio, "audio-chunk", session, { token, sequence, media_time, pcm });
    sequence += 1;
  }
  await send(audio, "audio-chunk", session, { token, sequence, media_time, last: true });
}
const speaking = speak(await readFile(process.argv[2])); // while frames are received

for await (const message of faps) {
  const [kind, frame] = read(message);
  if (kind === "end-of-faps") break;
  const values = new Float32Array(new Uint8Array(frame.values).buffer); // 68
  console.log("at", frame.media_time / 16000, "s the jaw opens by", values[2]); // FAP 3
}

await speaking;
await send(control, "close-session", session, { request: "2", token });
await control.receive();
