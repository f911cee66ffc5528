// wLipSync: its vowels as visemes, weight times volume as in its examples; then volume, weights and cepstrum.

import { readFile } from "node:fs/promises";
import { setTimeout } from "node:timers/promises";
import { runBlocks } from "./audio-thread.js";
import "wlipsync/audio-processor.js";
import { WLipSyncAudioNode } from "wlipsync/wlipsync.js";

const WASM = new URL(import.meta.resolve("wlipsync/wlipsync.wasm"));
const VISEMES = { A: "aa", E: "E", I: "ih", O: "oh", U: "ou" };
const STEP_S = 0.01;
const module = await WebAssembly.compile(await readFile(WASM));

export async function computeCurves(samples, profile) {
  const node = new WLipSyncAudioNode(null, profile, module);
  const { processor } = node;
  while (processor.exports === null) await setTimeout(1);
  const cepstrum = new Float32Array(
    processor.inputBuffer.buffer,
    processor.exports.mfccOut.value,
    profile.mfccNum,
  );
  const vowels = Object.keys(node.weights);
  const rows = runBlocks(
    samples,
    STEP_S,
    (block) => processor.process([[block]], [], node.parameterData),
    () => {
      const weights = Object.values(node.weights);
      return [...weights.map((weight) => weight * node.volume), node.volume, ...weights, ...cepstrum];
    },
  );
  const shown = vowels.map((vowel) => (vowel in VISEMES ? `viseme_${VISEMES[vowel]}` : `shown_${vowel}`));
  const cepstra = [...cepstrum].map((_, k) => `cepstrum_${k}`);
  return { names: [...shown, "volume", ...vowels.map((vowel) => `weight_${vowel}`), ...cepstra], rows };
}
