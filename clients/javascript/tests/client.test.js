// Tests of the built package in Node, with the gateway at $GATEWAY.

import assert from "node:assert/strict";
import { readFile } from "node:fs/promises";
import test from "node:test";
import { runInNewContext } from "node:vm";
import { Speaker, Viewer, readRecording } from "kouxing-client";

const { GATEWAY, SPEECH } = process.env;

test("reads recordings in JSON lines and CSV, with FAPs or shapes", () => {
  const named = { names: ["jawOpen", "mouthClose"], frames: [[0, Float32Array.of(0.25, 1)], [320, Float32Array.of(0.5, 0)]] };
  const json = [[0.25, 1], [0.5, 0]].map(([jawOpen, mouthClose], sequence) =>
    JSON.stringify({ time_s: sequence / 50, sequence, arkit: { jawOpen, mouthClose } }),
  );
  assert.deepEqual(readRecording(json.join("\n") + "\n"), named);
  assert.deepEqual(readRecording("time_s,jawOpen,mouthClose\n0.000,0.25,1\n0.020,0.5,0\n"), named);
  const faps = { names: null, frames: [[0, Float32Array.of(7, 8)]] };
  assert.deepEqual(readRecording('{"time_s": 0, "sequence": 0, "faps": [7, 8]}'), faps);
  assert.deepEqual(readRecording("time_s,viseme,expression,phone\n0,7,8,b\n"), faps);
  assert.throws(() => readRecording("Timecode,BlendShapeCount,JawOpen\n1:0:0:0.0,0,\n"), /no frames with a face/);
  assert.throws(() => readRecording("frame,jawOpen\n0,0.5\n"), /no times; add a column time_s/);
  for (const row of ["0,", "0, ", ",0.5", " ,0.5"]) {
    assert.throws(() => readRecording(`time_s,jawOpen\n${row}\n`), /frame 1 of the recording: a value is missing/);
  }
});

test("speech returns as frames, shapes, phones and sound", async () => {
  const wav = await readFile(SPEECH);
  const speaker = await Speaker.open(GATEWAY, { sampleRateHz: wav.readUInt32LE(24), ahead: true });
  const [faps, openings, symbols] = [[], [], []];
  let numSamples = 0;
  const handlers = {
    frame: (mediaTime, values) => faps.push([mediaTime, values[2]]),
    weights: (mediaTime, weights, names) => openings.push([mediaTime, weights[names.indexOf("jawOpen")]]),
    phone: ({ symbol, final }) => final && symbols.push(symbol),
    sound: (_, samples) => (numSamples += samples.length),
  };
  const viewer = new Viewer(GATEWAY, handlers, { session: speaker.session, shapes: "arkit" });
  await viewer.ready;
  const samples = new Int16Array(wav.buffer.slice(wav.indexOf("data") + 8));
  for (let begin = 0; begin < 16000; begin += 4000) {
    await speaker.push(samples.subarray(begin, begin + 4000));
    // The gateway drops what a busy viewer does not read in time.
    while (numSamples < begin + 3000) await new Promise((resolve) => setTimeout(resolve, 10));
  }
  await speaker.finish();
  viewer.close();
  assert.ok(Math.max(...faps.map(([, jaw]) => jaw)) > 200);
  assert.ok(Math.max(...openings.map(([, weight]) => weight)) > 0.1);
  const [times, shapeTimes] = [faps, openings].map((frames) => frames.slice(0, 25).map(([time]) => time));
  assert.deepEqual(shapeTimes, times);
  assert.deepEqual(symbols.slice(0, 4), ["n", "i", "h", "ao"]);
  assert.ok(numSamples > 15000);
});

test("wrong options, addresses and audio are rejected", async () => {
  await assert.rejects(Speaker.open(GATEWAY, { sampleRate: 48000 }), /unknown option sampleRate; use sampleRateHz/);
  await assert.rejects(Speaker.open("localhost:8080"), /localhost:8080 is not the address of a gateway, such as/);
  assert.throws(() => new Viewer(GATEWAY, {}, { shape: "arkit" }), /unknown option shape; use session, shapes/);
  assert.throws(() => new Viewer(GATEWAY, {}, { shapes: "ARKit" }), /unknown set of shapes ARKit; use arkit/);
  const speaker = await Speaker.open(GATEWAY);
  for (const [audio, name] of [[[0.5], "Array"], ["text", "String"], [null, "Null"], [new Float64Array(1), "Float64Array"]]) {
    await assert.rejects(speaker.push(audio), new RegExp(`not ${name}`));
  }
  await assert.rejects(speaker.push(Float32Array.of(0, 1000)), /must be from -1 to 1; divide/);
  await assert.rejects(speaker.push(Float32Array.of(NaN)), /must be from -1 to 1/);
  await speaker.push(Buffer.from("RIFF....WAVE"));
  await assert.rejects(speaker.finish(), /looks like the start of a WAV file/);
});

test("samples are converted at the services' full scale, also those of another realm, such as an iframe", async () => {
  const sent = [];
  const socket = { readyState: WebSocket.OPEN, bufferedAmount: 0, send: (pcm) => sent.push(pcm.slice().buffer) };
  for (const [encoding, samples] of [
    ["s16le", "Float32Array.of(0.5, -1, 2)"],
    ["f32le", "Int16Array.of(16384, -32768, 0)"],
  ]) {
    await new Speaker(socket, "voice", encoding, () => {}, () => {}).push(runInNewContext(samples));
  }
  assert.deepEqual(new Int16Array(sent[0]), Int16Array.of(16384, -32768, 32767));
  assert.deepEqual(new Float32Array(sent[1]), Float32Array.of(0.5, -1, 0));
});

test("a rejected session reports the reason", async () => {
  await assert.rejects(Speaker.open(GATEWAY, { sampleRateHz: 1000 }), /sample_rate_hz must be/);
  await assert.rejects(Speaker.open("http://127.0.0.1:1"), /cannot connect .*kouxing run.*token/);
});

test("a session continues after an error, unless the gateway closes the connection", async () => {
  const { WebSocket } = globalThis;
  let socket = null;
  globalThis.WebSocket = class {
    static OPEN = 1;
    readyState = 1;
    bufferedAmount = 0;
    sent = [];
    constructor() {
      socket = this;
    }
    send(data) {
      this.sent.push(data);
    }
    close() {}
    receive(message) {
      this.onmessage({ data: JSON.stringify(message) });
    }
  };
  try {
    const texts = [];
    const opening = Speaker.open(GATEWAY, {
      error: ({ message }) => texts.push(message),
      closed: ({ message }) => texts.push(`closed: ${message}`),
    });
    socket.receive({ type: "opened", session: "voice" });
    const speaker = await opening;
    socket.receive({ type: "error", code: "bad-mouth-profile", text: "unreadable" });
    await speaker.push(new Int16Array(4));
    assert.equal(socket.sent.length, 1);
    socket.receive({ type: "error", code: "refused", text: "this is JSON" });
    socket.readyState = 3;
    socket.onclose({ code: 1008 });
    await assert.rejects(speaker.push(new Int16Array(4)), /this is JSON/);
    assert.deepEqual(texts, ["unreadable", "this is JSON", "closed: this is JSON"]);
    const reopening = Speaker.open(GATEWAY, { closed: ({ message }) => texts.push(message) });
    socket.receive({ type: "opened", session: "voice" });
    await reopening;
    socket.onclose({ code: 1006, reason: "" }); // the gateway was killed
    assert.equal(texts.at(-1), "the connection to the gateway is lost; open another session");
    const rejected = Speaker.open(GATEWAY);
    socket.receive({ type: "opened", session: "voice" });
    const ending = (await rejected).finish();
    socket.onclose({ code: 1008, reason: "" });
    await assert.rejects(ending, /the gateway has ended the session; open a new one/);
    const last = Speaker.open(GATEWAY, { closed: (error) => texts.push(error) });
    socket.receive({ type: "opened", session: "voice" });
    (await last).close();
    socket.onclose({ code: 1006, reason: "" }); // the gateway did not answer the close
    assert.equal(texts.at(-1), null);
  } finally {
    globalThis.WebSocket = WebSocket;
  }
});

test("after a failed load, <kouxing-face> loads local lip sync again", async () => {
  class FakeElement {
    style = {};
    isConnected = true;
    append() {}
    addEventListener() {}
    attachShadow = () => this;
    hasAttribute = () => true;
    getAttribute = () => "";
  }
  const names = ["HTMLElement", "ResizeObserver", "customElements", "document"];
  Object.assign(globalThis, {
    HTMLElement: FakeElement,
    ResizeObserver: class {},
    customElements: { get() {}, define() {} },
    document: { createElement: () => new FakeElement() },
  });
  try {
    const { KouxingFace } = await import("kouxing-client/face");
    const face = new KouxingFace();
    const first = face.lips;
    assert.equal(face.lips, first);
    await assert.rejects(first, /the attribute local needs the package kouxing-lips; install it/);
    assert.notEqual(face.lips, first);
    await assert.rejects(face.lips);
  } finally {
    for (const name of names) delete globalThis[name];
  }
});

test("older versions of Node get an error", async () => {
  const { WebSocket } = globalThis;
  try {
    globalThis.WebSocket = class {
      constructor() {
        queueMicrotask(() => this.onerror()); // as in Node 22, without onclose
      }
    };
    await assert.rejects(Speaker.open(GATEWAY), /cannot connect .*kouxing run.*token/);
    globalThis.WebSocket = undefined; // as in Node 20
    await assert.rejects(Speaker.open(GATEWAY), /needs Node 22 or newer/);
    assert.throws(() => new Viewer(GATEWAY, {}), /needs Node 22 or newer/);
  } finally {
    globalThis.WebSocket = WebSocket;
  }
});
