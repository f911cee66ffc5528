// HeadAudio: the weights of the 15 Oculus visemes, then the viseme that it has detected (1 or 0).

import { readFile } from "node:fs/promises";
import { runBlocks } from "./audio-thread.js";
import "@met4citizen/headaudio/modules/headworklet.mjs";
import { HeadAudio } from "@met4citizen/headaudio/modules/headaudio.mjs";

const MODEL = new URL(import.meta.resolve("@met4citizen/headaudio/dist/model-en-mixed.bin"));
const STEP_S = 0.01;
const model = await readFile(MODEL, "base64");

export async function computeCurves(samples) {
  const node = new HeadAudio(null, { processorOptions: { visemeEventsEnabled: true } });
  await node.loadModel(`data:application/octet-stream;base64,${model}`);
  const weights = new Map(node.visemeNames.map((name) => [name, 0]));
  node.onvalue = (name, value) => weights.set(name, value);
  const silence = node.visemeNames.indexOf("viseme_sil");
  let detected = silence;
  node.onviseme = ({ viseme }) => (detected = viseme ?? detected);
  node.onended = () => (detected = silence);
  const rows = runBlocks(
    samples,
    STEP_S,
    (block) => node.processor.process([[block]], [], node.parameterData),
    () => {
      node.update(1000 * STEP_S);
      return [...weights.values(), ...node.visemeNames.map((_, k) => Number(k === detected))];
    },
  );
  return { names: [...weights.keys(), ...node.visemeNames.map((name) => `detected_${name}`)], rows };
}
