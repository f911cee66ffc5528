// Sync of sound and image over ten minutes: the real Playout, Sound and worklet with a simulated sound
// card and network. Simulated time runs as fast as the machine can.

import assert from "node:assert/strict";
import test from "node:test";
import { Playout, SAMPLES_PER_MS } from "../../services/gateway/page/playout.js";
import { Sound } from "../../services/gateway/page/sound.js";

const RATE_HZ = 16000;
const BLOCK = 128; // samples, as the Web Audio API processes them
const CHUNK_MS = 20;
const FRAME_MS = 80; // delay of a FAP frame after its sound
const JITTER_MS = 15; // of the network
const MISREAD_MS = 4; // maximum error of a reading of the sound card's clock
const CLICK_EVERY = RATE_HZ; // samples of media time
const SETTLE_S = 10;

let card = null; // the sound card of AudioContext
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
  audioWorklet = { addModule: () => import( "../../services/gateway/page/sound-worklet.js") };
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

/** A sound card with a clock error (ppm) and a latency. */
class Card {
  nowMs = 0;
  latencyMs = 40;
  clicks = []; // [time, ms, level]
  #speed;
  #random;
  #numPlayed = 0;

  constructor(ppm, random) {
    this.#speed = 1 + ppm / 1e6;
    this.#random = random;
  }

  /** When a frame of the context is audible, ms. */
  #audibleMs(frame) {
    return (frame / SAMPLES_PER_MS) * this.#speed + this.latencyMs;
  }

  readClock() {
    const frame = Math.floor(((this.nowMs - this.latencyMs) * SAMPLES_PER_MS) / this.#speed / 256) * 256;
    const performanceTime = this.#audibleMs(frame) + MISREAD_MS * (2 * this.#random() - 1);
    return { contextTime: frame / RATE_HZ, performanceTime };
  }

  #addClick(audibleMs, level) {
    const last = this.clicks.at(-1);
    if (last === undefined || audibleMs - last[0] > 1) this.clicks.push([audibleMs, level]);
    else if (level > last[1]) last.splice(0, 2, audibleMs, level); // one click in two blocks
  }

  play(nowMs) {
    this.nowMs = nowMs;
    const output = new Float32Array(BLOCK);
    while (this.#audibleMs(this.#numPlayed) < nowMs + this.latencyMs) {
      globalThis.currentFrame = this.#numPlayed;
      this.processor.process([], [[output]]);
      const level = output.reduce((max, value) => Math.max(max, value));
      if (level > 0.1) this.#addClick(this.#audibleMs(this.#numPlayed + output.indexOf(level)), level);
      this.#numPlayed += BLOCK;
    }
  }
}

/** Return a generator of pseudo-random numbers from 0 to 1. */
function makeRandom(seed) {
  let state = seed;
  return () => {
    state = (1664525 * state + 1013904223) % 2 ** 32;
    return state / 2 ** 32;
  };
}

/**
 * Play one click per second from a sender with a clock error of senderPpm on a card with an error of
 * cardPpm. Return for each click { atS, lateMs: how late its sound was after its image, level, delayMs:
 * the sound's delay at that time }.
 */
async function simulate({ forS, senderPpm = 0, cardPpm = 0, change = () => {} }) {
  const random = makeRandom(1);
  card = new Card(cardPpm, random);
  const playout = new Playout();
  const sound = new Sound(() => {});
  await sound.turnOn();
  const clicks = [];
  let [arrivedMs, numClicks] = [0, 0];
  for (let media = 0; media < forS * RATE_HZ; media += CHUNK_MS * SAMPLES_PER_MS) {
    const spokenMs = (media / SAMPLES_PER_MS + CHUNK_MS) * (1 + senderPpm / 1e6);
    arrivedMs = Math.max(arrivedMs, spokenMs + JITTER_MS * random() ** 4);
    card.play(arrivedMs);
    change(card, arrivedMs / 1000);
    const samples = new Int16Array(CHUNK_MS * SAMPLES_PER_MS);
    if (media % CLICK_EVERY === 0) samples[0] = 16384;
    playout.soundArrived(arrivedMs, media, samples.length);
    sound.push(media, samples);
    const frameTime = media + samples.length - FRAME_MS * SAMPLES_PER_MS;
    if (frameTime >= 0) playout.frameArrived(arrivedMs, frameTime);
    playout.isAudible = true;
    playout.outputLatencyMs = sound.outputLatencyMs;
    playout.adjust(arrivedMs);
    sound.align(arrivedMs, playout.offsetMs);
    for (; card.clicks[numClicks]?.[0] < arrivedMs; numClicks++) {
      const [audibleMs, level] = card.clicks[numClicks];
      const imageMs = playout.mediaAt(audibleMs) / SAMPLES_PER_MS;
      const lateMs = 1000 * Math.round(imageMs / 1000) - imageMs;
      clicks.push({ atS: audibleMs / 1000, lateMs: -lateMs, level, delayMs: playout.delayMs });
    }
  }
  return clicks;
}

function mean(values) {
  return values.reduce((sum, value) => sum + value, 0) / values.length;
}

test("sound and image stay in sync for ten minutes with clocks that differ by 200 ppm", async () => {
  const clicks = await simulate({ forS: 600, senderPpm: 100, cardPpm: -100 });
  const settled = clicks.filter(({ atS }) => atS > SETTLE_S);
  assert.ok(settled.length >= 600 - SETTLE_S - 1, `${settled.length}: a click is lost`);
  assert.ok(settled.every(({ level }) => level > 0.3), "a click was faded by a jump");
  const lates = settled.map(({ lateMs }) => lateMs);
  assert.ok(Math.max(...lates.map(Math.abs)) < 5, `${Math.min(...lates)} to ${Math.max(...lates)} ms`);
  const drift = mean(lates.slice(-60)) - mean(lates.slice(0, 60));
  assert.ok(Math.abs(drift) < 1, `${drift} ms`);
  const delays = settled.map(({ delayMs }) => delayMs);
  assert.ok(Math.max(...delays) - Math.min(...delays) < 10, "the delay is constant");
});

test("a sound card with 180 ms more latency is compensated within a second", async () => {
  const clicks = await simulate({
    forS: 40,
    change(to, atS) {
      if (atS > 15) to.latencyMs = 220;
    },
  });
  const settled = clicks.filter(({ atS }) => atS > SETTLE_S && !(atS > 15 && atS < 17));
  const lates = settled.map(({ lateMs }) => lateMs);
  assert.ok(Math.max(...lates.map(Math.abs)) < 5, `${Math.min(...lates)} to ${Math.max(...lates)} ms`);
  assert.ok(clicks.at(-1).delayMs > 220, "the image waits for the sound");
});
