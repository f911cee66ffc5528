// Streams a wav file and prints the opening of the jaw.
//
// usage: node stream.mjs FILE.wav [CONTROL-ADDRESS]

import { readFile } from "node:fs/promises";
import { ask, connectControl, connectDealer, fail, read, send, subscribe } from "./kouxing.mjs";

const EXTENSIBLE = 0xfffe;
const [file, controlAddress] = process.argv.slice(2);
if (!file) fail("usage: node stream.mjs FILE.wav [CONTROL-ADDRESS]");

/** Return the PCM of a wav file, its format as fields of open-session, and the size of a frame. */
async function readWav(path) {
  const wav = await readFile(path).catch((error) => fail(error.message));
  const chunks = {};
  let at = wav.toString("latin1", 0, 4) === "RIFF" ? 12 : wav.length;
  while (at + 8 <= wav.length) {
    const size = wav.readUInt32LE(at + 4) || wav.length; // 0: the file was written as a stream
    chunks[wav.toString("latin1", at, at + 4)] ??= wav.subarray(at + 8, at + 8 + size);
    at += 8 + size + (size % 2);
  }
  const { "fmt ": header, data } = chunks;
  if (!header || !data) fail(`${path} is not a wav file; convert yours: ffmpeg -i FILE speech.wav`);
  const code = header.readUInt16LE(0) === EXTENSIBLE ? header.readUInt16LE(24) : header.readUInt16LE(0);
  const width = header.readUInt16LE(14) / 8;
  const [numChannels, rate] = [header.readUInt16LE(2), header.readUInt32LE(4)];
  const isFloat = code === 3 && width === 4;
  const isKnown = isFloat || (code === 1 && [2, 3, 4].includes(width));
  if (!isKnown || ![1, 2].includes(numChannels) || rate < 8000 || rate > 48_000) {
    fail(`${path}: convert it: ffmpeg -i ${path} -c:a pcm_s16le -ar 16000 -ac 1 speech.wav`);
  }
  let pcm = data;
  if (!isFloat) {
    pcm = Buffer.alloc(2 * Math.floor(data.length / width)); // the upper 16 bits
    for (let i = 0; 2 * i < pcm.length; i++) data.copy(pcm, 2 * i, (i + 1) * width - 2, (i + 1) * width);
  }
  const encoding = isFloat ? "f32le" : "s16le";
  return {
    format: { encoding, sample_rate_hz: rate, num_channels: numChannels },
    pcm,
    frameBytes: numChannels * (isFloat ? 4 : 2),
  };
}

const { format, pcm, frameBytes } = await readWav(file);
const control = connectControl(controlAddress);
const [answer, opened] = await ask(control, "open-session", "", { paced: false, ...format });
if (answer !== "session-opened") fail(opened.text);
const { session, token } = opened;

const faps = subscribe(opened.faps, session, ["fap-frame", "end-of-faps", "joined"]); // joined last
await faps.receive(); // joined: no later frame is missed

// A global: zeromq closes a socket that no variable holds, although it is still receiving.
const audio = connectDealer(opened.audio);

async function speak() {
  audio.receive().then((answer) => fail(read(answer)[1].text)); // only rejected audio is answered
  const rate = format.sample_rate_hz;
  const numFrames = Math.floor(pcm.length / frameBytes);
  const step = Math.floor(rate / 50); // 20 ms
  let sequence = 1;
  const timeAt = (frame) => Math.floor((frame * 16000) / rate);
  for (let frame = 0; frame < numFrames; frame += step) {
    const end = Math.min(frame + step, numFrames);
    const chunk = pcm.subarray(frame * frameBytes, end * frameBytes);
    await send(audio, "audio-chunk", session, { token, sequence, media_time: timeAt(frame), pcm: chunk });
    sequence += 1;
  }
  await send(audio, "audio-chunk", session, { token, sequence, media_time: timeAt(numFrames), last: true });
}
const speaking = speak(); // while frames are received

let newest = 0;
for await (const message of faps) {
  const [kind, frame] = read(message);
  if (kind === "end-of-faps") break;
  if (kind !== "fap-frame" || frame.sequence <= newest) continue; // some are repeated for others
  newest = frame.sequence;
  const values = new Float32Array(new Uint8Array(frame.values).buffer); // 68
  console.log("at", frame.media_time / 16000, "s the jaw opens by", values[2]); // FAP 3
}

await speaking;
await ask(control, "close-session", session, { token });
process.exit(); // the audio socket is still receiving
