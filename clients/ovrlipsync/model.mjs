// Writes the models of `kouxing export web` as C: node model.mjs MODELS FOLDER writes lips_model.h and lips_model.c.
// The header has the constants of the server's modules and the places of the arrays.

import { readFile, readdir, writeFile } from "node:fs/promises";
import { join, resolve } from "node:path";
import { pathToFileURL } from "node:url";
import { product } from "../kouxing-lips/engine/lip-predictor.js";
import { loadModel } from "../kouxing-lips/engine/model.js";
import { readGraph } from "../kouxing-lips/engine/onnx-file.js";

const MODULES = "closures expressiveness learned lipPrediction lips mel resample rest segmenter shapes stream track traits vad".split(" ");
const LAYERS = "entry first.ih first.hh second.ih second.hh output".split(" ");
const ARRAYS = /^(mel\.bands|lips\.(?!projection|entry_weights)|traits\.(weights|bias)|shapes\.oculus)/;
const TYPES = { Float32Array: "float", Float64Array: "double", Int8Array: "int8_t" };
const WORD_BYTES = 8;

const [models, folder] = process.argv.slice(2);
const model = await loadModel(pathToFileURL(`${resolve(models)}/`));
const { tensors } = readGraph(new Uint8Array(await readFile(join(models, "encoder.onnx"))));
const sources = (await readdir(import.meta.dirname)).filter((name) => /\.[ch]$/.test(name));
const code = await Promise.all(sources.map((name) => readFile(join(import.meta.dirname, name), "utf8")));
const used = new Set(code.join().match(/[A-Z]\w+/g)); // other constants are left out
const lines = ["/* Written by model.mjs. */", "#include <stdint.h>", "extern const uint64_t LIPS_MODEL[];"];
const parts = [];
let numBytes = 0;

for (const layer of LAYERS) {
  const { shape, values } = tensors[`${layer}.integers`];
  const [rows, columns] = shape;
  const transposed = Int8Array.from({ length: rows * columns }, (_, i) => values[(i % rows) * columns + Math.floor(i / rows)]);
  addArray(`encoder.${layer}.integers`, transposed, [columns, rows]);
  for (const name of ["scales", "bias"]) addArray(`encoder.${layer}.${name}`, tensors[`${layer}.${name}`].values);
}
for (const name of ["step", "min_scale"]) define(`encoder.${name}`, tensors[name].values[0]);
define("encoder.num_features", tensors["features.lengths"].values[0]);
define("encoder.num_phones", tensors["features.lengths"].values[1]);
const entry = product(model.arrays["lips.projection"], model.arrays["lips.entry_weights"]);
addArray("lips.entry", entry.values, entry.shape);
for (const [name, { values, shape }] of Object.entries(model.arrays)) if (ARRAYS.test(name)) addArray(name, values, shape);
for (const name of MODULES) for (const [key, value] of Object.entries(model.constants[name])) define(`${name}.${key}`, value);
for (const [name, value] of Object.entries(model.closureRule)) define(`rule.${name}`, value);
for (const [name, value] of Object.entries(model.voices)) define(`voice.${name}`, value);
define("slice_samples", model.constants.pcm.SLICE_SAMPLES);
define("media_rate_hz", model.constants.clock.MEDIA_RATE_HZ);
define("frame_rounding", model.constants.animator.ROUNDING);
define("mouth_faps", model.mouthFaps);
define("delay_s", model.defaults.delayS);
define("frame_rate_hz", model.defaults.frameRateHz);
define("expressiveness", model.defaults.expressiveness);

const bytes = Buffer.concat(parts);
const words = Array.from(new BigUint64Array(new Uint8Array(bytes).buffer), (word) => `0x${word.toString(16)}`);
const rows = Array.from({ length: Math.ceil(words.length / 8) }, (_, row) => words.slice(8 * row, 8 * row + 8).join(","));
await writeFile(join(folder, "lips_model.h"), `${lines.join("\n")}\n`);
await writeFile(join(folder, "lips_model.c"), `#include "lips_model.h"\nconst uint64_t LIPS_MODEL[] = {\n${rows.join(",\n")}};\n`);

function nameOf(text) {
  return text.replace(/([a-z])([A-Z])/g, "$1_$2").replaceAll(".", "_").toUpperCase();
}

/** Add an array, and a macro for it and each of its sizes. */
function addArray(text, values, shape = [values.length]) {
  const name = nameOf(text);
  lines.push(`#define ${name} ((const ${TYPES[values.constructor.name]} *)((const char *)LIPS_MODEL + ${numBytes}))`);
  shape.forEach((size, axis) => lines.push(`#define ${name}_SIZE_${axis} ${size}`));
  const padding = (WORD_BYTES - (values.byteLength % WORD_BYTES)) % WORD_BYTES;
  parts.push(Buffer.from(values.buffer, values.byteOffset, values.byteLength), Buffer.alloc(padding));
  numBytes += values.byteLength + padding;
}

/** Define a number, a list of numbers, or a list of rows. */
function define(text, value) {
  const name = nameOf(text);
  if (Array.isArray(value) && used.has(name)) {
    const flat = value.flat();
    const type = flat.every(Number.isInteger) ? "int" : "double";
    lines.push(`static const ${type} ${name}[] = {${flat.join(", ")}};`);
  }
  if (Array.isArray(value)) define(`${text}_LENGTH`, value.length);
  else if (used.has(name)) lines.push(`#define ${name} (${value})`);
}
