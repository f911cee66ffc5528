// HeadAudio: a row has the weights of the 15 Oculus visemes, then which one it has found (1 or 0).

import { readFile } from "node:fs/promises";
import { ROW_MS, play } from "./audio-thread.js";
import "@met4citizen/headaudio/modules/headworklet.mjs";
import { HeadAudio } from "@met4citizen/headaudio/modules/headaudio.mjs";

const MODEL = new URL(import.meta.resolve("@met4citizen/headaudio/dist/model-en-mixed.bin"));

export async function rowsOf(samples) {
  const node = new HeadAudio(null, { processorOptions: { visemeEventsEnabled: true } });
  const model = await readFile(MODEL, "base64");
  await node.loadModel(`data:application/octet-stream;base64,${model}`);
  const weights = new Map(node.visemeNames.map((name) => [name, 0]));
  node.onvalue = (name, value) => weights.set(name, value);
  // A node never shows viseme_aa, its number 0, but its processor finds it.
  const silence = node.visemeNames.indexOf("viseme_sil");
  let found = silence;
  node.onviseme = ({ viseme }) => (found = viseme ?? found);
  node.onended = () => (found = silence);
  const rows = [];
  play(node, samples, () => {
    node.update(ROW_MS);
    rows.push([...weights.values(), ...node.visemeNames.map((_, k) => Number(k === found))]);
  });
  return rows;
}
