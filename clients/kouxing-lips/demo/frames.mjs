// Prints the output of the engine for 32-bit samples in a file: node frames.mjs MODELS FILE OPTIONS.

import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";
import { LipEngine } from "../engine/engine.js";

const [models, file, options] = process.argv.slice(2);
const { chunk, ...rest } = JSON.parse(options);
try {
  const engine = await LipEngine.load({ models: pathToFileURL(`${models}/`), ...rest });
  const samples = new Float32Array(new Uint8Array(readFileSync(file)).buffer);
  const frames = [];
  const phones = [];
  for (let begin = 0; begin < samples.length; begin += chunk) {
    frames.push(...engine.push(samples.subarray(begin, begin + chunk)));
    phones.push(...engine.newPhones);
  }
  frames.push(...engine.finish());
  phones.push(...engine.newPhones);
  const plain = (_name, value) => (value instanceof Float32Array ? [...value] : value);
  process.stdout.write(JSON.stringify({ names: engine.names, frames, phones }, plain));
} catch (error) {
  process.stdout.write(JSON.stringify({ error: error.message }));
}
