// Opening and closing the sound card, which is a fake.

import assert from "node:assert/strict";
import test from "node:test";
import { Sound } from "../../services/gateway/page/sound.js";

const contexts = [];
let load; // loads the worklet

class FakeNode {
  port = { postMessage() {} };
  gain = { value: 1 };
  connect = (node) => node;
  disconnect() {}
}

test.beforeEach(() => {
  contexts.length = 0;
  load = async () => {};
  globalThis.AudioContext = class {
    state = "running";
    audioWorklet = { addModule: () => load() };
    constructor() {
      contexts.push(this);
    }
    async resume() {}
    async suspend() {}
    async close() {
      this.state = "closed";
    }
  };
  globalThis.AudioWorkletNode = globalThis.GainNode = globalThis.DelayNode = FakeNode;
  globalThis.MediaStreamAudioDestinationNode = class {
    stream = {};
  };
});

test("sound can be turned on again after its worklet could not be loaded", async () => {
  const states = [];
  const sound = new Sound(() => states.push(sound.state));
  load = async () => {
    throw new Error("offline");
  };
  await assert.rejects(sound.turnOn(), /offline/);
  assert.deepEqual(states, ["blocked"]);
  assert.equal(contexts[0].state, "closed");
  load = async () => {};
  await sound.turnOn();
  assert.equal(sound.state, "on");
});

test("sound can be turned on again after the sound card could not be opened", async () => {
  const sound = new Sound(() => {});
  const { AudioContext } = globalThis;
  globalThis.AudioContext = class {
    constructor() {
      throw new Error("no device");
    }
  };
  await assert.rejects(sound.turnOn(), /no device/);
  globalThis.AudioContext = AudioContext;
  await sound.turnOn();
  assert.equal(sound.state, "on");
});

test("a recording that starts while sound is being turned on shares its sound card", async () => {
  let finishLoading;
  load = () => new Promise((resolve) => (finishLoading = resolve));
  const sound = new Sound(() => {});
  const started = Promise.all([sound.turnOn(), sound.tap()]);
  finishLoading();
  await started;
  assert.equal(contexts.length, 1);
  sound.untap();
  sound.untap();
  assert.equal(sound.state, "on");
});

test("closing sound releases the sound card, also while it is being opened", async () => {
  const sound = new Sound(() => {});
  const opening = sound.turnOn();
  sound.close();
  await opening;
  assert.ok(!sound.isPlaying);
  await sound.turnOn();
  assert.equal(sound.state, "on");
  sound.close();
  assert.deepEqual(contexts.map(({ state }) => state), ["closed", "closed"]);
  assert.equal(sound.offsetMs, null);
});
