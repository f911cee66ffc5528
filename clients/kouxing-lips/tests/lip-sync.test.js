// Sources that are stopped, closed or replaced while they open. The browser's parts are fakes.

import assert from "node:assert/strict";
import { readFile, readdir } from "node:fs/promises";
import test from "node:test";
import { runInNewContext } from "node:vm";
import { loadModel } from "../engine/model.js";
import { LipSync } from "../index.js";

class FakeWorker {
  static newest = null;
  static count = 0;
  static error = null; // answer to the request to load
  isTerminated = false;
  messages = [];
  constructor() {
    FakeWorker.newest = this;
    FakeWorker.count++;
  }
  postMessage(message) {
    this.messages.push(message);
    if (message.type !== "load") return;
    if (FakeWorker.error) queueMicrotask(() => this.fail("load", FakeWorker.error));
    else this.answer("loaded");
  }
  /** Answer the newest request after the current call. */
  answer(type) {
    const { session } = this.messages.at(-1);
    queueMicrotask(() => this.onmessage({ data: { type, session, names: {} } }));
  }
  fail(request, text, session) {
    this.onmessage({ data: { type: "error", request, session, text } });
  }
  terminate() {
    this.isTerminated = true;
  }
}

class FakeNode {
  port = { postMessage() {} };
  connect(node) {
    return node;
  }
  disconnect() {}
  start() {}
  stop() {}
}

class AudioNode extends FakeNode {}

class AudioBuffer {}

class HTMLMediaElement {}

/** A node that has a context, and throws an error if it is disconnected from a node to which it is not connected. */
class ElementNode extends AudioNode {
  outputs = new Set();
  constructor(nodeContext) {
    super();
    this.context = nodeContext;
  }
  connect(node) {
    this.outputs.add(node);
    return node;
  }
  disconnect(node) {
    assert.ok(this.outputs.delete(node));
  }
}

class DelayNode extends FakeNode {
  delayTime = { value: 0 };
}

class FakeContext extends EventTarget {
  state = "running";
  sampleRate = 48000;
  currentTime = 0;
  audioWorklet = { addModule: async () => {} };
  destination = new FakeNode();
  async resume() {}
}

class MediaStreamTrack {
  isLive = true;
  getSettings = () => ({ sampleRate: 48000 });
  stop() {
    this.isLive = false;
  }
}

class MediaStream {
  track = new MediaStreamTrack();
  getAudioTracks = () => [this.track];
}

let answerPrompt; // the user allows the microphone
let stream;
let context;

test.beforeEach(() => {
  FakeWorker.count = 0;
  FakeWorker.error = null;
  stream = new MediaStream();
  context = new FakeContext();
  const getUserMedia = () => new Promise((resolve) => (answerPrompt = () => resolve(stream)));
  Object.defineProperty(globalThis, "navigator", { value: { mediaDevices: { getUserMedia } }, configurable: true });
  Object.assign(globalThis, {
    document: new EventTarget(),
    location: { href: "http://localhost/" },
    Worker: FakeWorker,
    AudioWorkletNode: FakeNode,
    MediaStreamAudioSourceNode: FakeNode,
    AudioBufferSourceNode: FakeNode,
    MediaElementAudioSourceNode: ElementNode,
    DelayNode,
    GainNode: class extends AudioNode {
      context = context;
    },
    MessageChannel: class {},
  });
});

/** Wait until the worker has received a request to open a session. */
async function opening() {
  while (FakeWorker.newest.messages.at(-1).type !== "open") await new Promise(setImmediate);
}

/** Answer the request to open a session. */
async function open() {
  await opening();
  FakeWorker.newest.answer("opened");
}

test("unknown options are rejected before the worker starts", async () => {
  await assert.rejects(LipSync.create({ shape: ["arkit"] }), /unknown option shape; use models, .*shapes/);
  assert.equal(FakeWorker.newest, null);
});

test("a failed load ends the worker", async () => {
  FakeWorker.error = "the model cannot be loaded";
  await assert.rejects(LipSync.create({ context }), /the model cannot be loaded/);
  assert.ok(FakeWorker.newest.isTerminated);
});

test("the URL of the models may lack the slash at its end", async () => {
  for (const url of ["file:///nowhere/models", "file:///nowhere/models/"]) {
    await assert.rejects(loadModel(url), /cannot load file:\/\/\/nowhere\/models\/\w+\.\w+ .*set the option models/);
  }
});

test("a start page instead of the models gives a clear error", async (t) => {
  t.mock.method(globalThis, "fetch", async () => new Response("<!doctype html>"));
  await assert.rejects(loadModel("http://localhost/models"), /http:\/\/localhost\/models\/model.json is not a model; set the option models/);
});

test("webpack leaves out the modules of Node", async () => {
  const folder = new URL("../engine/", import.meta.url);
  for (const name of await readdir(folder)) {
    const source = await readFile(new URL(name, folder), "utf8");
    assert.doesNotMatch(source, /(from |import\()"node:/, name);
  }
});

test("a closed lip sync, a closed context and a source of another context give a clear error", async () => {
  const lips = await LipSync.create({ context });
  const other = Object.assign(new AudioNode(), { context: new FakeContext() });
  await assert.rejects(lips.listenTo(other), /belongs to another audio context; pass that context/);
  context.state = "closed";
  await assert.rejects(lips.listenTo(new AudioBuffer()), /the audio context is closed/);
  lips.close();
  for (const call of [() => lips.open(16000), () => lips.listenTo(new AudioBuffer()), () => lips.listenToMicrophone()]) {
    await assert.rejects(call, /this lip sync is closed; create another one/);
  }
});

test("sources of another realm, such as an iframe, are followed", async () => {
  const lips = await LipSync.create({ context });
  await followWith(lips, runInNewContext("class MediaStream { getAudioTracks() { return [1]; } } new MediaStream()"));
  const node = runInNewContext("class AudioNode { connect() {} disconnect() {} } class GainNode extends AudioNode {} new GainNode()");
  await followWith(lips, Object.assign(node, { context }));
  assert.equal(lips.node, node);
  await assert.rejects(lips.listenTo(Object.assign(node, { context: new FakeContext() })), /belongs to another audio context/);
});

test("an error of another call does not reject open()", async () => {
  const lips = await LipSync.create();
  const notices = [];
  lips.addEventListener("notice", ({ detail }) => notices.push(detail));
  lips.express({ joy: 1 });
  const result = lips.open(16000);
  FakeWorker.newest.fail("express", "no sound is open");
  FakeWorker.newest.answer("opened");
  await result;
  assert.deepEqual(notices, ["no sound is open"]);
});

test("an error of open() rejects it", async () => {
  const lips = await LipSync.create();
  const result = lips.open(0);
  FakeWorker.newest.fail("open", "wrong rate", 1);
  await assert.rejects(result, /wrong rate/);
});

let numWorkers = 0;

/** Import the worker; return a function that sends it a message, and the messages that it posts. */
async function startWorker() {
  const messages = [];
  globalThis.self = { postMessage: (message) => messages.push(message) };
  await import(`../worker.js?${++numWorkers}`);
  const worker = globalThis.self;
  return { messages, send: (data) => worker.onmessage({ data }) };
}

test("the worker reports broken sound once, and still finishes", async (t) => {
  const { send, messages } = await startWorker();
  await send({ type: "load", models: new URL("../models/", import.meta.url).href, phones: false });
  const input = { close: t.mock.fn() };
  await send({ type: "open", session: 3, options: {}, input });
  input.onmessage({ data: { samples: new Float32Array(320).fill(NaN), endS: 0 } });
  assert.equal(input.close.mock.callCount(), 1);
  const text = "a sample is NaN; samples must be in [-1, 1]; divide integers by 32768";
  assert.deepEqual(messages.at(-1), { type: "error", request: "sound", session: 3, text });
  await send({ type: "finish", session: 3 });
  assert.equal(messages.at(-1).type, "finished");
});

test("the worker names the request that failed", async () => {
  const { send, messages } = await startWorker();
  await send({ type: "finish", session: 7 });
  const [{ type, request, session }] = messages;
  assert.deepEqual([type, request, session], ["error", "finish", 7]);
});

const aborted = { name: "AbortError" };

/** Let lip sync follow the microphone, which the user allows. */
async function followMicrophone(lips) {
  const listening = lips.listenToMicrophone();
  answerPrompt();
  await open();
  await listening;
}

test("the notice about a telephone's sample rate stays when the sound starts, and when the tab is visible again", async () => {
  stream.track.getSettings = () => ({ sampleRate: 8000 });
  const lips = await LipSync.create({ context });
  const notices = [];
  lips.addEventListener("notice", ({ detail }) => notices.push(detail));
  await followMicrophone(lips);
  context.dispatchEvent(new Event("statechange"));
  assert.match(notices.at(-1), /the microphone sends 8 kHz/);
  for (globalThis.document.hidden of [true, false]) globalThis.document.dispatchEvent(new Event("visibilitychange"));
  assert.match(notices.at(-1), /the microphone sends 8 kHz/);
  await followWith(lips, new AudioBuffer());
  context.dispatchEvent(new Event("statechange"));
  assert.equal(notices.at(-1), "");
});

test("stop() releases the microphone", async () => {
  const lips = await LipSync.create({ context });
  await followMicrophone(lips);
  assert.ok(stream.track.isLive);
  lips.stop();
  assert.ok(!stream.track.isLive);
});

for (const end of ["stop", "close"]) {
  test(`${end}() also works while the user is asked for the microphone`, async () => {
    const lips = await LipSync.create({ context });
    const listening = lips.listenToMicrophone();
    lips[end]();
    answerPrompt();
    await assert.rejects(listening, aborted);
    assert.ok(!stream.track.isLive);
    assert.equal(lips.node, null);
  });
}

test("stop() also works while the worker opens the session", async () => {
  const lips = await LipSync.create({ context });
  const listening = lips.listenToMicrophone();
  answerPrompt();
  await opening();
  lips.stop();
  FakeWorker.newest.answer("opened");
  await assert.rejects(listening, aborted);
  assert.ok(!stream.track.isLive);
  assert.equal(lips.node, null);
});

test("stop() also works while the sound starts", async () => {
  const lips = await LipSync.create({ context });
  context.state = "suspended";
  context.resume = async () => lips.stop();
  await followMicrophone(lips);
  assert.ok(!stream.track.isLive);
});

test("the source that was chosen last is followed, even if an earlier one takes longer to open", async () => {
  const lips = await LipSync.create({ context });
  const first = lips.listenToMicrophone();
  const second = lips.listenTo(new AudioBuffer());
  await open();
  await second;
  const { node } = lips;
  answerPrompt();
  await assert.rejects(first, aborted);
  assert.ok(!stream.track.isLive);
  assert.equal(lips.node, node);
});

test("a wrong source is rejected, and the current one is still followed", async () => {
  const lips = await LipSync.create({ context });
  await followMicrophone(lips);
  const { node } = lips;
  await assert.rejects(lips.listenTo(5), TypeError);
  assert.equal(lips.node, node);
  assert.ok(stream.track.isLive);
});

/** Let a lip sync of its own follow a source. */
async function follow(source) {
  const lips = await LipSync.create({ context });
  await followWith(lips, source);
  return lips;
}

async function followWith(lips, source) {
  const listening = lips.listenTo(source);
  await open();
  await listening;
}

const outputDelayS = (node) => [...node.outputs].find((output) => output instanceof DelayNode).delayTime.value;

test("a media element is always heard: directly, or delayed while it is followed", async () => {
  const lips = await LipSync.create({ context });
  const element = new HTMLMediaElement();
  let node = null;
  for (let time = 0; time < 2; time++) {
    await followWith(lips, element);
    ({ node } = lips);
    assert.equal(node.outputs.size, 2); // the worklet and the delay
    assert.ok(outputDelayS(node) > 0);
    lips.stop();
    assert.equal(node.outputs.size, 1);
    assert.equal(outputDelayS(node), 0);
  }
  const listening = lips.listenTo(element);
  await opening();
  lips.stop();
  FakeWorker.newest.answer("opened");
  await assert.rejects(listening, aborted);
  assert.equal(outputDelayS(node), 0);
});

test("several lip syncs can follow one media element, which is heard once", async () => {
  const element = new HTMLMediaElement();
  const first = await follow(element);
  const second = await follow(element);
  const { node } = first;
  assert.equal(second.node, node);
  assert.equal(node.outputs.size, 3); // two worklets and the delay
  first.stop();
  assert.ok(outputDelayS(node) > 0);
  second.stop();
  assert.equal(outputDelayS(node), 0);
});

test("a media element is still played after its node was followed", async () => {
  const element = new HTMLMediaElement();
  const lips = await follow(element);
  const { node } = lips;
  await followWith(lips, node);
  assert.equal(outputDelayS(node), 0); // heard directly
  await followWith(lips, element);
  assert.ok(outputDelayS(node) > 0);
});

test("a buffer that is replaced does not report its end", async () => {
  const lips = await LipSync.create({ context });
  let numEnded = 0;
  lips.addEventListener("ended", () => numEnded++);
  const first = lips.listenTo(new AudioBuffer());
  await open();
  await first;
  const { node } = lips;
  const second = lips.listenTo(new AudioBuffer());
  await opening();
  node.onended?.(); // browsers report it after node.stop()
  assert.equal(numEnded, 0);
  FakeWorker.newest.answer("opened");
  await second;
  lips.node.onended();
  assert.equal(numEnded, 1);
});

test("stop() ends pushed audio, and finish() ends it once", async () => {
  const lips = await LipSync.create();
  const { newest } = FakeWorker;
  const count = (type) => newest.messages.filter((message) => message.type === type).length;
  assert.throws(() => lips.push(new Float32Array(320)), /no sound is open for push\(\); call open\(\)/);
  for (const end of ["stop", "finish"]) {
    const opened = lips.open(16000);
    newest.answer("opened");
    await opened;
    lips.push(new Float32Array(320));
    const ended = lips[end]();
    newest.answer("finished");
    await ended;
    assert.throws(() => lips.push(new Float32Array(320)), /no sound is open/);
    await assert.rejects(lips.finish(), /no sound is open/);
  }
  lips.stop();
  assert.deepEqual([count("push"), count("finish")], [2, 2]);
});

test("stop() also works while open() waits", async () => {
  const lips = await LipSync.create();
  const opened = lips.open(16000);
  lips.stop();
  FakeWorker.newest.answer("opened");
  await assert.rejects(opened, aborted);
  assert.throws(() => lips.push(new Float32Array(320)), /no sound is open/);
});

test("the face of two pushed minutes is known from the start", async () => {
  const lips = await LipSync.create();
  const opened = lips.open(16000);
  FakeWorker.newest.answer("opened");
  await opened;
  const frames = [0, 1, 119, 120].map((timeS) => ({ timeS, faps: Float32Array.of(timeS) }));
  FakeWorker.newest.onmessage({ data: { type: "frames", session: 1, frames, phones: [], startS: null } });
  assert.equal(lips.at(0.5).faps[0], 0.5);
});

const closedContext = async () => {
  throw new DOMException("the context is closed", "InvalidStateError");
};

/** Resume the sound while the browser blocks it, so that lip sync waits for a click or a key. */
async function waitForGesture(lips, t) {
  t.mock.timers.enable({ apis: ["setTimeout"] });
  context.state = "suspended";
  context.resume = () => new Promise(() => {});
  const resuming = lips.resume();
  t.mock.timers.tick(1000);
  await resuming;
}

test("a lip sync can be closed twice, and opens no audio context afterwards", async () => {
  globalThis.AudioContext = class extends FakeContext {
    async close() {
      if (this.state === "closed") await closedContext(); // an unhandled rejection fails the test
      this.state = "closed";
    }
  };
  const [used, unused] = [await LipSync.create(), await LipSync.create()];
  assert.equal(used.context.state, "running");
  for (const lips of [used, unused, used]) lips.close();
  assert.equal(used.context.state, "closed");
  assert.throws(() => unused.context, /this lip sync is closed/);
  await new Promise(setImmediate);
});

test("a click after close() does not resume the sound", async (t) => {
  const lips = await LipSync.create({ context });
  await waitForGesture(lips, t);
  lips.close();
  context.resume = t.mock.fn(closedContext);
  globalThis.document.dispatchEvent(new Event("pointerdown"));
  assert.equal(context.resume.mock.callCount(), 0);
});

test("a click or a visible tab has no effect if the page has closed its context", async (t) => {
  const lips = await LipSync.create({ context });
  await followMicrophone(lips);
  await waitForGesture(lips, t);
  context.resume = t.mock.fn(closedContext);
  globalThis.document.dispatchEvent(new Event("visibilitychange"));
  globalThis.document.dispatchEvent(new Event("keydown"));
  await new Promise(setImmediate); // an unhandled rejection fails the test
  assert.equal(context.resume.mock.callCount(), 2);
});

test("the notice about a tab in the background disappears when the tab is visible", async () => {
  const lips = await LipSync.create({ context });
  await followMicrophone(lips);
  const notices = [];
  lips.addEventListener("notice", ({ detail }) => notices.push(detail));
  for (const hidden of [true, false]) {
    globalThis.document.hidden = hidden;
    globalThis.document.dispatchEvent(new Event("visibilitychange"));
  }
  assert.match(notices[0], /in the background/);
  assert.deepEqual(notices.slice(1), [""]);
});

test("HeadAudio starts after its models are loaded, once if loadModel() is called twice", async () => {
  const { HeadAudio } = await import("../headaudio.js");
  const head = new HeadAudio(context);
  head.stop();
  await assert.rejects(head.start(), /the models are not loaded; call loadModel\(\) first/);
  const loading = [head.loadModel(), head.loadModel()];
  await open();
  await Promise.all(loading);
  assert.equal(FakeWorker.count, 1);
});

test("a node of wLipSync that cannot follow the sound ends the worker", async () => {
  context.audioWorklet.addModule = async () => {
    throw new Error("blocked");
  };
  const { createWLipSyncNode } = await import("../wlipsync.js");
  await assert.rejects(createWLipSyncNode(context), /blocked/);
  assert.ok(FakeWorker.newest.isTerminated);
});

test("HeadAudio reports each start and end of speech once, whatever the laughter", async () => {
  const { HeadAudio } = await import("../headaudio.js");
  const head = new HeadAudio(context);
  const events = [];
  head.onstarted = head.onended = ({ event }) => events.push(event);
  const loading = head.loadModel();
  await open();
  await loading;
  const { session } = FakeWorker.newest.messages.findLast(({ type }) => type === "open");
  for (const [isSpeaking, isLaughing] of [[false, true], [true, true], [true, false], [false, false]]) {
    const frames = [{ timeS: events.length, isSpeaking, isLaughing }];
    FakeWorker.newest.onmessage({ data: { type: "frames", session, frames, phones: [], startS: 0 } });
  }
  assert.deepEqual(events, ["started", "ended"]);
});
