// live2d-motionsync: its vowels as visemes, at 60 Hz, with the settings of loadDefaultMotionSync. The model is a stub
// with one parameter per vowel. The package expects a document, to which it adds its core as a script.

import { runInThisContext } from "node:vm";
import { SAMPLE_RATE_HZ, runBlocks } from "./audio-thread.js";

const PARAMETERS = { ParamA: "aa", ParamI: "ih", ParamU: "ou", ParamE: "E", ParamO: "oh" };
const STEP_S = 1 / 60;

globalThis.window = globalThis;
globalThis.document = {
  getElementById: () => null,
  createElement: () => ({}),
  body: { appendChild: ({ innerHTML }) => runInThisContext(innerHTML) },
};
globalThis.MediaStream = class {};
globalThis.AudioContext = class {
  audioWorklet = { addModule() {} };
  createMediaStreamSource = () => ({ connect() {} });
};
globalThis.AudioWorkletNode = class {
  port = {};
};
const log = console.log;
console.log = () => {}; // the core prints its version
const { MotionSync } = await import("live2d-motionsync/stream");
const weights = new Array(Object.keys(PARAMETERS).length).fill(0);
const coreModel = {
  _parameterIds: Object.keys(PARAMETERS),
  getParameterCount: () => weights.length,
  getParameterValueByIndex: (index) => weights[index] ?? 0,
  setParameterValueByIndex: (index, value) => {
    if (index < weights.length) weights[index] = value ?? 0; // the model has no parameter for silence
  },
};
const sync = new MotionSync({ coreModel, motionManager: { update() {} } }); // the core supports only a few instances
await sync.loadDefaultMotionSync();
await sync.play({ getAudioTracks: () => [null] });
console.log = log;

export async function computeCurves(samples) {
  run(new Float32Array(SAMPLE_RATE_HZ)); // a second of silence after the previous recording
  return { names: Object.values(PARAMETERS).map((viseme) => `viseme_${viseme}`), rows: run(samples) };
}

function run(samples) {
  return runBlocks(
    samples,
    STEP_S,
    (block) => sync.onMessage({ data: { eventType: "data", audioBuffer: block } }),
    () => {
      sync.updateMotionSync();
      return [...weights];
    },
  );
}
