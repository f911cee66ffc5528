// The microphone and files in its place: they stop, start and reconnect. Browser parts are fakes.

import assert from "node:assert/strict";
import test from "node:test";
import { translate } from "../../services/gateway/page/language.js";
import { Microphone } from "../../services/gateway/page/microphone.js";
import { SpeechControls } from "../../services/gateway/page/speech-controls.js";

const FILE = { name: "speech.wav", size: 1 };

class FakeWebSocket {
  static OPEN = 1;
  static newest = null;
  readyState = 0;
  sent = [];
  constructor() {
    FakeWebSocket.newest = this;
  }
  send(text) {
    this.sent.push(JSON.parse(text));
  }
  close() {
    this.readyState = 3;
  }
  /** Open the connection and a session. */
  openSession(session) {
    this.readyState = FakeWebSocket.OPEN;
    this.onopen();
    this.onmessage({ data: JSON.stringify({ type: "opened", session }) });
  }
}

/** As in browsers, it starts only once. */
class FakeSource {
  static newest = null;
  #hasStarted = false;
  constructor() {
    FakeSource.newest = this;
  }
  connect() {}
  start() {
    assert.ok(!this.#hasStarted, "a source starts only once");
    this.#hasStarted = true;
  }
}

const stream = { getTracks: () => [{ stop() {} }] };

test.beforeEach((t) => {
  t.mock.timers.enable({ apis: ["setTimeout"] });
  globalThis.WebSocket = FakeWebSocket;
  globalThis.location = { protocol: "http:", host: "localhost:8080", hash: "" };
  Object.defineProperty(globalThis, "navigator", {
    value: { mediaDevices: { getUserMedia: async () => stream } },
    configurable: true,
  });
  globalThis.AudioContext = class {
    sampleRate = 48000;
    audioWorklet = { addModule: async () => {} };
    close() {}
    resume() {}
    createMediaStreamSource = () => ({ connect() {} });
    decodeAudioData = async () => ({ getChannelData: () => [1] });
  };
  globalThis.AudioWorkletNode = class {
    port = {};
  };
  globalThis.AudioBufferSourceNode = FakeSource;
  globalThis.MediaStreamAudioDestinationNode = class {
    stream = stream;
  };
  globalThis.fetch = async () => ({
    ok: true,
    headers: new Map(),
    arrayBuffer: async () => new ArrayBuffer(0),
  });
});

/** Return a microphone and the states that it reports. */
function makeMicrophone() {
  const states = [];
  const microphone = new Microphone({
    mouthProfile: () => "",
    language: () => "",
    lipModel: () => "learned",
    state: (state) => states.push(state),
    level() {},
    session() {},
    fileEnded: (name) => states.push(`${name} ended`),
    error: ({ text }) => states.push(text),
  });
  return { microphone, states };
}

test("without the gateway, the error says so, and no audio context stays open", async (t) => {
  const close = t.mock.fn();
  globalThis.AudioContext = class {
    audioWorklet = { addModule: () => Promise.reject(new DOMException("network error", "AbortError")) };
    close = close;
  };
  const { microphone, states } = makeMicrophone();
  await microphone.start();
  assert.deepEqual(states.slice(-2), [translate("gatewaySilent"), "off"]);
  assert.equal(close.mock.callCount(), 1);
});

test("the end of a file stops it after its last frames", async (t) => {
  const { microphone, states } = makeMicrophone();
  await microphone.startFile(FILE);
  FakeWebSocket.newest.openSession("file");
  FakeSource.newest.onended();
  assert.ok(microphone.isActive);
  t.mock.timers.tick(1000);
  assert.ok(!microphone.isActive);
  assert.deepEqual(states.slice(-3), ["on", "speech.wav ended", "off"]);
});

test("the end of a file does not stop the microphone that was started after it", async (t) => {
  const { microphone, states } = makeMicrophone();
  await microphone.startFile(FILE);
  FakeWebSocket.newest.openSession("file");
  FakeSource.newest.onended();
  await microphone.start();
  FakeWebSocket.newest.openSession("voice");
  t.mock.timers.tick(1000);
  assert.ok(microphone.isActive);
  assert.equal(states.at(-1), "on");
});

test("a file continues in another session if the connection is interrupted", async (t) => {
  const { microphone, states } = makeMicrophone();
  await microphone.startFile(FILE);
  FakeWebSocket.newest.openSession("first");
  FakeWebSocket.newest.onclose();
  assert.equal(states.at(-1), "interrupted");
  t.mock.timers.tick(500);
  FakeWebSocket.newest.openSession("second");
  assert.equal(states.at(-1), "on");
  assert.deepEqual(FakeWebSocket.newest.sent.at(-1), { lip_model: "learned" });
  FakeSource.newest.onended();
  t.mock.timers.tick(1000);
  assert.equal(states.at(-1), "off");
});

test("a microphone reconnects if its network is down, although the socket does not report it", async (t) => {
  const port = {};
  globalThis.AudioWorkletNode = class {
    port = port;
  };
  const { microphone, states } = makeMicrophone();
  await microphone.start();
  const dead = FakeWebSocket.newest;
  dead.openSession("first");
  dead.bufferedAmount = 1 << 20;
  let nowMs = 0;
  t.mock.method(performance, "now", () => nowMs);
  for (; nowMs <= 6000 && states.at(-1) === "on"; nowMs += 20) {
    port.onmessage({ data: { chunk: new Int16Array(960), rms: 0, recordedMs: Date.now() } });
  }
  assert.equal(states.at(-1), "interrupted");
  assert.equal(dead.readyState, 3);
  t.mock.timers.tick(500);
  FakeWebSocket.newest.openSession("second");
  dead.onclose();
  assert.equal(states.at(-1), "on");
});

test("the browser's reason has no period of its own", async () => {
  navigator.mediaDevices.getUserMedia = async () => {
    throw new Error("The object can not be found here.");
  };
  const { microphone, states } = makeMicrophone();
  await microphone.start();
  assert.ok(states.some((text) => text.includes("not be found here. Close other programs")));
});

test("errors of a file do not mention the microphone", async () => {
  const { microphone, states } = makeMicrophone();
  const withBody = (arrayBuffer) => async () => ({ ok: true, headers: new Map(), arrayBuffer });
  globalThis.fetch = withBody(async () => {
    throw new TypeError("network error");
  });
  await microphone.startFile(FILE);
  assert.ok(states.includes("Cannot play the file: network error. Try again, or choose another file."));
  globalThis.fetch = withBody(async () => new ArrayBuffer(0));
  await microphone.startFile(FILE);
  FakeWebSocket.newest.onclose();
  assert.ok(states.includes("The gateway closed the connection. Choose the file again."));
});

test("a microphone above 48 kHz is captured at its rate, and filtered to a fraction of it", async () => {
  const filters = [];
  globalThis.BiquadFilterNode = class {
    constructor(_, options) {
      filters.push(options.type);
    }
    connect = (next) => next;
  };
  globalThis.AudioContext = class extends globalThis.AudioContext {
    constructor(options) {
      super();
      assert.ok(!("sampleRate" in options), "Firefox supports only the device's rate");
    }
    sampleRate = 96000;
    createMediaStreamSource = () => ({ connect: (next) => next });
  };
  const { microphone } = makeMicrophone();
  await microphone.start();
  FakeWebSocket.newest.openSession("voice");
  assert.equal(FakeWebSocket.newest.sent[0].sample_rate_hz, 48000);
  assert.deepEqual(filters, ["lowpass", "lowpass"]);
});

test("a microphone that cannot be captured is reported and released", async () => {
  let numClosed = 0;
  globalThis.AudioContext = class extends globalThis.AudioContext {
    close() {
      numClosed++;
    }
    createMediaStreamSource = () => {
      throw new Error("different sample-rate is currently not supported.");
    };
  };
  const { microphone, states } = makeMicrophone();
  await microphone.start();
  assert.ok(!microphone.isActive);
  assert.equal(states.at(-1), "off");
  assert.ok(states.some((text) => text.includes("different sample-rate")));
  assert.equal(numClosed, 1);
});

test("the end of an abandoned microphone does not stop a newer one", async () => {
  const track = { stop() {} };
  navigator.mediaDevices.getUserMedia = async () => ({ getTracks: () => [track] });
  const { microphone, states } = makeMicrophone();
  const abandoned = microphone.start();
  await Promise.resolve();
  const { onended } = track;
  const newer = microphone.start();
  await Promise.all([abandoned, newer]);
  onended();
  assert.ok(microphone.isActive);
  assert.equal(states.at(-1), "starting");
});

/** Return speech controls, their buttons by id, and a sound that is on. */
function makeControls() {
  const buttons = {};
  const toasts = [];
  const makeButton = () => ({ setAttribute() {} });
  globalThis.document = { getElementById: (id) => (buttons[id] ??= makeButton()) };
  const sound = {
    isWanted: true,
    get state() {
      return this.isWanted ? "on" : "off";
    },
    async turnOn() {
      this.isWanted = true;
    },
    turnOff() {
      this.isWanted = false;
    },
  };
  const ignore = () => {};
  const handlers = { mouthProfile: () => "", language: () => "", lipModel: () => null, level: ignore };
  const others = { error: ignore, session: ignore, fileStarted: ignore, toast: (text) => toasts.push(text) };
  const controls = new SpeechControls(sound, { ...handlers, ...others });
  return { controls, microphone: controls.microphone, buttons, sound, toasts };
}

const drop = (...files) => globalThis.document.ondrop({ preventDefault() {}, dataTransfer: { files } });

test("sound that the user turns off stays off when the microphone or a file ends", async () => {
  const { microphone, buttons, sound } = makeControls();
  await microphone.startFile(FILE);
  FakeWebSocket.newest.openSession("file");
  assert.equal(sound.state, "on", "a file is audible");
  buttons.sound.onclick();
  microphone.stop();
  assert.equal(sound.state, "off");

  buttons.sound.onclick();
  await microphone.start();
  FakeWebSocket.newest.openSession("voice");
  assert.equal(sound.state, "off", "the user's own voice is not audible");
  buttons.sound.onclick();
  buttons.sound.onclick();
  microphone.stop();
  assert.equal(sound.state, "off");
});

test("sound is turned on again after the microphone", async () => {
  const { microphone, sound } = makeControls();
  await microphone.start();
  FakeWebSocket.newest.openSession("voice");
  microphone.stop();
  assert.equal(sound.state, "on");
});

test("a file that is dropped while the user's mouth is being learned is not played", () => {
  const { controls, microphone } = makeControls();
  controls.pause();
  drop(FILE);
  assert.ok(!microphone.isActive);
  controls.resume();
  drop(FILE);
  assert.ok(microphone.isFile);
});

test("the first of several dropped files is played, and the page says so", () => {
  const { microphone, toasts } = makeControls();
  drop(FILE, { name: "other.wav", size: 1 });
  assert.ok(microphone.isFile);
  assert.deepEqual(toasts, [translate("severalFiles", { file: FILE.name })]);
});

test("a folder or a file that was deleted is not called a problem of the gateway", async () => {
  globalThis.fetch = () => Promise.reject(new TypeError("Failed to fetch"));
  for (const [arrayBuffer, key] of [
    [() => Promise.reject(new DOMException("gone", "NotFoundError")), "fileUnreadable"],
    [async () => new ArrayBuffer(1), "gatewaySilent"],
  ]) {
    const { microphone, states } = makeMicrophone();
    await microphone.startFile({ ...FILE, slice: () => ({ arrayBuffer }) });
    assert.deepEqual(states.slice(-2), [translate(key, { file: FILE.name }), "off"]);
  }
});

test("a missing microphone and a muted one are reported", async () => {
  navigator.mediaDevices.getUserMedia = () => Promise.reject(new DOMException("not found", "NotFoundError"));
  const { microphone, states } = makeMicrophone();
  await microphone.start();
  assert.deepEqual(states.slice(-2), [translate("microphoneMissing"), "off"]);

  const track = { muted: true, stop() {} };
  navigator.mediaDevices.getUserMedia = async () => ({ getTracks: () => [track] });
  await microphone.start();
  assert.deepEqual(states.slice(-2), ["starting", translate("microphoneMuted")]);
  track.onmute();
  assert.deepEqual(states.slice(-2), [translate("microphoneMuted"), translate("microphoneMuted")]);
  microphone.stop();
});
