// The audio worklets, run in Node, and the uplink of a microphone's chunks.

import assert from "node:assert/strict";
import test from "node:test";
import { AudioUplink } from "../../services/gateway/page/audio-uplink.js";
import { Player } from "../../services/gateway/page/player.js";

const BLOCK = 128; // samples, as the Web Audio API processes them
const processors = {};

globalThis.AudioWorkletProcessor = class {
  port = { posted: [], postMessage: (message) => this.port.posted.push(message) };
};
globalThis.registerProcessor = (name, processor) => (processors[name] = processor);
globalThis.sampleRate = 48000;
globalThis.currentFrame = 0;
await import( "../../services/gateway/page/microphone-worklet.js");
await import( "../../services/gateway/page/sound-worklet.js");

test("the microphone is cut into chunks of 20 ms without gaps, and clipped", () => {
  const capture = new processors.capture();
  const input = Float32Array.from({ length: 15 * BLOCK }, (_, i) => (i % 3 === 0 ? 1.5 : i / 4096));
  for (let begin = 0; begin < input.length; begin += BLOCK) {
    assert.equal(capture.process([[input.subarray(begin, begin + BLOCK)]]), true);
  }
  const { posted } = capture.port;
  assert.deepEqual(posted.map(({ chunk }) => chunk.length), [960, 960]);
  const captured = posted.flatMap(({ chunk }) => [...chunk]);
  const expected = input.slice(0, 1920).map((value) => Math.min(32767, Math.round(value * 32768)));
  assert.deepEqual(captured, [...expected]);
});

test("chunks of a microphone above 48 kHz have a fraction of its samples", () => {
  globalThis.sampleRate = 176400;
  const capture = new processors.capture();
  globalThis.sampleRate = 48000;
  const input = Float32Array.from({ length: 32 * BLOCK }, (_, i) => i / 8192);
  for (let begin = 0; begin < input.length; begin += BLOCK) {
    capture.process([[input.subarray(begin, begin + BLOCK)]]);
  }
  const [{ chunk }] = capture.port.posted;
  assert.deepEqual([...chunk], Array.from({ length: 882 }, (_, i) => 4 * (4 * i + 3)));
});

/** Play blocks; return the output. */
function play(player, numBlocks) {
  return Array.from({ length: numBlocks }, () => {
    const block = new Float32Array(BLOCK);
    player.process([], [[block]]);
    globalThis.currentFrame += BLOCK;
    return [...block];
  }).flat();
}

function playerWith(anchor) {
  globalThis.currentFrame = 0;
  const player = new processors["sound-player"]();
  player.port.onmessage({ data: { anchor } });
  return player;
}

test("sound is played at its media time, faded in and out against clicks", () => {
  const player = playerWith(1000);
  player.port.onmessage({ data: { mediaTime: 1256, samples: new Int16Array(512).fill(16384) } });
  const output = play(player, 8);
  assert.ok(output.slice(0, 256).every((value) => value === 0));
  assert.equal(output[256], 0.5 / 64);
  assert.ok(output.slice(320, 768).every((value) => value === 0.5));
  assert.equal(output[768], (0.5 * 63) / 64);
  assert.ok(output.slice(768, 832).every((value, i) => i === 0 || value < output[767 + i]));
  assert.ok(output.slice(832).every((value) => value === 0));
});

test("the sound of another session is forgotten", () => {
  const player = playerWith(0);
  player.port.onmessage({ data: { mediaTime: 0, samples: new Int16Array(8000).fill(16384) } });
  player.port.onmessage({ data: { clear: true } });
  player.port.onmessage({ data: { mediaTime: 0, samples: new Int16Array(256).fill(16384) } });
  const output = play(player, 8);
  assert.ok(output[255] > 0);
  assert.ok(output.slice(320).every((value) => value === 0));
});

test("a player forgets the sound of another session, and keeps it in a new epoch", () => {
  let numCleared = 0;
  const player = new Player({ clear: () => numCleared++ });
  player.reset(true);
  assert.equal(numCleared, 1);
  player.reset(false);
  assert.equal(numCleared, 1);
});

test("a jump waits until the sound has faded out", () => {
  const player = playerWith(0);
  player.port.onmessage({ data: { mediaTime: 0, samples: new Int16Array(8000).fill(16384) } });
  play(player, 4);
  player.port.onmessage({ data: { anchor: 2000 } });
  const output = play(player, 2);
  for (let i = 1; i < output.length; i++) {
    assert.ok(Math.abs(output[i] - output[i - 1]) <= 0.5 / 64 + 1e-6, `a click at ${i}`);
  }
  assert.ok(output.includes(0));
  assert.equal(output.at(-1), 0.5, "it continues at the new position");
});

test("a small distance is corrected without a jump", () => {
  const player = playerWith(0);
  const tone = Int16Array.from({ length: 16000 }, (_, i) => 16384 * Math.sin(0.3 * i));
  player.port.onmessage({ data: { mediaTime: 0, samples: tone } });
  play(player, 10);
  player.port.onmessage({ data: { anchor: 40.25 } });
  const output = play(player, 100);
  for (let i = 1; i < output.length; i++) {
    assert.ok(Math.abs(output[i] - output[i - 1]) < 0.16, `a click at ${i}`);
  }
  for (let i = output.length - 100; i < output.length; i++) {
    const expected = 0.5 * Math.sin(0.3 * (10 * BLOCK + i + 40.25));
    assert.ok(Math.abs(output[i] - expected) < 0.005, `${output[i]} for ${expected}`);
  }
});

class FakeSocket {
  readyState = 1;
  bufferedAmount = 0;
  sent = [];
  send(message) {
    this.sent.push(typeof message === "string" ? JSON.parse(message) : message.byteLength);
  }
}

test("chunks are dropped and reported while the network is too slow", () => {
  const socket = new FakeSocket();
  const uplink = new AudioUplink(socket, 16000);
  const chunk = () => new Int16Array(320);
  uplink.send(20, 20, chunk());
  socket.bufferedAmount = 1 << 20;
  uplink.send(40, 40, chunk());
  uplink.send(60, 60, chunk());
  socket.bufferedAmount = 0;
  uplink.send(80, 80, chunk());
  uplink.send(100, 100, chunk());
  assert.deepEqual(socket.sent, [640, { skip: 640 }, 640, 640]);
  assert.equal(uplink.ageMs(100, 100 * 16), 0, "media time continues");
  for (const recordedMs of [120, 140, 1000]) uplink.send(1020, recordedMs, chunk());
  assert.deepEqual(socket.sent.slice(4), [{ skip: 640 }, 640], "a busy page sent them too late");
});

test("a network that accepts nothing for 5 s is down; a slow one is not", () => {
  const socket = new FakeSocket();
  const uplink = new AudioUplink(socket, 16000);
  for (let ms = 20; ms <= 5060; ms += 20) {
    socket.bufferedAmount = ms === 40 ? 0 : 1 << 20;
    uplink.send(ms, ms, new Int16Array(320));
    assert.ok(!uplink.isDown(ms), `after ${ms} ms`);
  }
  uplink.send(5080, 5080, new Int16Array(320));
  assert.ok(uplink.isDown(5080));
});

test("the age of sound counts from its recording, even if chunks are late", () => {
  const uplink = new AudioUplink(new FakeSocket(), 48000);
  assert.equal(uplink.ageMs(0, 0), null);
  uplink.send(1070, 1070, new Int16Array(960)); // 50 ms late
  uplink.send(1041, 1041, new Int16Array(960)); // 1 ms late
  assert.equal(uplink.ageMs(1101, 1600), 0);
});

test("sound that the sound card loses affects the age only for a while", () => {
  const uplink = new AudioUplink(new FakeSocket(), 16000);
  for (let ms = 20; ms <= 40000; ms += 20) {
    const lostMs = ms > 20000 ? 700 : 0;
    uplink.send(ms + lostMs, ms + lostMs, new Int16Array(320));
  }
  assert.equal(uplink.ageMs(40700, 40000 * 16), 0);
});

test("the age of sound does not include a pause of the microphone, as during a change of the headset", () => {
  const uplink = new AudioUplink(new FakeSocket(), 16000);
  for (const ms of [20, 40, 8060]) uplink.send(ms, ms, new Int16Array(320));
  assert.equal(uplink.ageMs(8060, 60 * 16), 0);
});
