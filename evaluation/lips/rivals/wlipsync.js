// wLipSync: a row has the volume, the weight of each phoneme of the profile, which phoneme it has
// found (1 or 0), and the 12 cepstral coefficients that profiles are made from.

import { readFile } from "node:fs/promises";
import { setTimeout } from "node:timers/promises";
import { play } from "./audio-thread.js";
import "wlipsync/audio-processor.js";
import { WLipSyncAudioNode } from "wlipsync/wlipsync.js";

const WASM = new URL(import.meta.resolve("wlipsync/wlipsync.wasm"));

export async function rowsOf(samples, profile) {
  const node = new WLipSyncAudioNode(null, profile, await WebAssembly.compile(await readFile(WASM)));
  const { port, processor } = node;
  while (processor.exports === null) await setTimeout(1);
  const { onmessage } = port;
  let found = -1;
  port.onmessage = (message) => {
    found = message.data.index;
    onmessage(message);
  };
  const cepstra = new Float32Array(
    processor.inputBuffer.buffer,
    processor.exports.mfccOut.value,
    profile.mfccNum,
  );
  const rows = [];
  play(node, samples, () => {
    const isFound = profile.mfccs.map((_, k) => Number(k === found));
    rows.push([node.volume, ...Object.values(node.weights), ...isFound, ...cepstra]);
  });
  return rows;
}
