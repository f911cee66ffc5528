// Sound and picture over an hour, at the pace of the machine: Playout, Sound and its worklet as they
// are, on a sound card and behind a network that are made up.

import assert from "node:assert/strict";
import test from "node:test";
import { Playout, SAMPLES_PER_MS } from "../playout.js";
import { Sound } from "../sound.js";

const RATE_HZ = 16000;
const BLOCK = 128; // samples, as the Web Audio API processes them
const CHUNK_MS = 20;
const FRAME_MS = 80; // a FAP frame comes so long after its sound
const JITTER_MS = 15; // of the network
const MISREAD_MS = 4; // a clock of the sound card is off by up to so much
const CLICK_EVERY = RATE_HZ; // samples of media time
const SETTLE_S = 10;

let card = null; // what AudioContext plays on
const processors = {};

globalThis.sampleRate = RATE_HZ;
globalThis.currentFrame = 0;
globalThis.AudioWorkletProcessor = class {
  port = { postMessage: (data) => card.node.port.onmessage({ data }) };
};
globalThis.registerProcessor = (name, processor) => (processors[name] = processor);
globalThis.AudioContext = class {
  state = "running";
  destination = null;
  audioWorklet = { addModule: () => import("../sound-worklet.js") };
  get outputLatency() {
    return card.latencyMs / 1000;
  }
  async resume() {}
  getOutputTimestamp() {
    return card.readClock();
  }
};
globalThis.AudioWorkletNode = class {
  constructor(_context, name) {
    const processor = new processors[name]();
    this.port = { postMessage: (data) => processor.port.onmessage({ data }) };
    card.node = this;
    card.processor = processor;
  }
  connect(node) {
    return node;
  }
};
globalThis.GainNode = class {
  gain = { value: 1 };
  connect(node) {
    return node;
  }
};

/** A sound card whose clock is off, ppm, and which is heard latencyMs after it is played. */
class Card {
  nowMs = 0;
  latencyMs = 40;
  heard = []; // [when, ms, its level] of each click
  #pace;
  #chance;
  #numPlayed = 0;

  constructor(ppm, chance) {
    this.#pace = 1 + ppm / 1e6;
    this.#chance = chance;
  }

  /** When a frame of the context is heard, ms. */
  #heardMs(frame) {
    return (frame / SAMPLES_PER_MS) * this.#pace + this.latencyMs;
  }

  readClock() {
    const frame = Math.floor(((this.nowMs - this.latencyMs) * SAMPLES_PER_MS) / this.#pace / 256) * 256;
    const performanceTime = this.#heardMs(frame) + MISREAD_MS * (2 * this.#chance() - 1);
    return { contextTime: frame / RATE_HZ, performanceTime };
  }

  #hear(heardMs, level) {
    const last = this.heard.at(-1);
    if (last === undefined || heardMs - last[0] > 1) this.heard.push([heardMs, level]);
    else if (level > last[1]) last.splice(0, 2, heardMs, level); // one click lies in two blocks
  }

  play(nowMs) {
    this.nowMs = nowMs;
    const output = new Float32Array(BLOCK);
    while (this.#heardMs(this.#numPlayed) < nowMs + this.latencyMs) {
      globalThis.currentFrame = this.#numPlayed;
      this.processor.process([], [[output]]);
      const level = output.reduce((most, value) => Math.max(most, value));
      if (level > 0.1) this.#hear(this.#heardMs(this.#numPlayed + output.indexOf(level)), level);
      this.#numPlayed += BLOCK;
    }
  }
}

/** Return numbers that only look like chance, 0 to 1. */
function chanceFrom(seed) {
  let state = seed;
  return () => {
    state = (1664525 * state + 1013904223) % 2 ** 32;
    return state / 2 ** 32;
  };
}

/**
 * Play clicks, one a second, from a sender whose clock is off by senderPpm, on a card that is off by
 * cardPpm; return for each how late its sound was heard after its picture, ms, how loud, and for how
 * long sound waited then.
 */
async function listen({ forS, senderPpm = 0, cardPpm = 0, change = () => {} }) {
  const chance = chanceFrom(1);
  card = new Card(cardPpm, chance);
  const playout = new Playout();
  const sound = new Sound(() => {});
  await sound.turnOn();
  const clicks = [];
  let [arrivedMs, numHeard] = [0, 0];
  for (let media = 0; media < forS * RATE_HZ; media += CHUNK_MS * SAMPLES_PER_MS) {
    const spokenMs = (media / SAMPLES_PER_MS + CHUNK_MS) * (1 + senderPpm / 1e6);
    arrivedMs = Math.max(arrivedMs, spokenMs + JITTER_MS * chance() ** 4);
    card.play(arrivedMs);
    change(card, arrivedMs / 1000);
    const samples = new Int16Array(CHUNK_MS * SAMPLES_PER_MS);
    if (media % CLICK_EVERY === 0) samples[0] = 16384;
    playout.soundArrived(arrivedMs, media, samples.length);
    sound.push(media, samples);
    const frame = media + samples.length - FRAME_MS * SAMPLES_PER_MS;
    if (frame >= 0) playout.frameArrived(arrivedMs, frame);
    playout.isHeard = true;
    playout.outputLatencyMs = sound.outputLatencyMs;
    playout.adjust(arrivedMs);
    sound.align(arrivedMs, playout.offsetMs);
    for (; card.heard[numHeard]?.[0] < arrivedMs; numHeard++) {
      const [heardMs, level] = card.heard[numHeard];
      const pictureMs = playout.mediaAt(heardMs) / SAMPLES_PER_MS;
      const lateMs = 1000 * Math.round(pictureMs / 1000) - pictureMs;
      clicks.push({ atS: heardMs / 1000, lateMs: -lateMs, level, delayMs: playout.delayMs });
    }
  }
  return clicks;
}

function mean(values) {
  return values.reduce((sum, value) => sum + value, 0) / values.length;
}

test("in an hour of clocks that are 200 ppm apart sound and picture stay together, unheard", async () => {
  const clicks = await listen({ forS: 3600, senderPpm: 100, cardPpm: -100 });
  const settled = clicks.filter(({ atS }) => atS > SETTLE_S);
  assert.ok(settled.length >= 3600 - SETTLE_S - 1, `${settled.length}: none is lost`);
  const levels = settled.map(({ level }) => level);
  assert.ok(Math.min(...levels) > 0.3, `${Math.min(...levels)}: none was faded, as for a leap`);
  const lates = settled.map(({ lateMs }) => lateMs);
  assert.ok(Math.max(...lates.map(Math.abs)) < 5, `${Math.min(...lates)} to ${Math.max(...lates)} ms`);
  const drift = mean(lates.slice(-60)) - mean(lates.slice(0, 60));
  assert.ok(Math.abs(drift) < 1, `${drift} ms`);
  const delays = settled.map(({ delayMs }) => delayMs);
  assert.ok(Math.max(...delays) - Math.min(...delays) < 10, "nor does sound wait for longer");
});

test("another sound card, heard 180 ms later, is made up for in a second", async () => {
  const clicks = await listen({
    forS: 40,
    change(to, atS) {
      if (atS > 15) to.latencyMs = 220;
    },
  });
  const settled = clicks.filter(({ atS }) => atS > SETTLE_S && !(atS > 15 && atS < 17));
  const lates = settled.map(({ lateMs }) => lateMs);
  assert.ok(Math.max(...lates.map(Math.abs)) < 5, `${Math.min(...lates)} to ${Math.max(...lates)} ms`);
  assert.ok(clicks.at(-1).delayMs > 220, "the picture waits for it");
});
