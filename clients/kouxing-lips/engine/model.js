// The files of `kouxing export web`.

import { floats, halfToFloat } from "./math.js";
import { Network } from "./network.js";
import { readGraph } from "./onnx-file.js";
import { PhoneLm } from "./phone-lm.js";

const FORMAT = "kouxing-lips 7";
const FINAL = "final"; // value of the option phones
const FILES = ["encoder.onnx", "model.bin", "model.json"];
const PHONES_FILE = "phones.bin";
const BLOCKS_FILE = "blocks.onnx"; // finds final phones
const ARRAYS = {
  float16: Uint16Array,
  float32: Float32Array,
  float64: Float64Array,
  int8: Int8Array,
  int32: Int32Array,
  uint8: Uint8Array,
};

/**
 * Load the models.
 *
 * @param base URL of the folder with the files, with or without a slash at its end; in Node also a file URL
 * @param options { phones: true also loads the phone recognizer, "final" also the block network }
 * @returns a promise of { encoder: Network, phoneLm: PhoneLm or null, blocks: Network or null, arrays:
 *   { values, shape } by name, constants, ... }; it is rejected if a file is missing or of another version
 */
export async function loadModel(base, { phones = false } = {}) {
  if (![true, false, FINAL].includes(phones)) throw new RangeError(`phones is ${phones}; it must be true, false or "${FINAL}"`);
  const files = [...FILES, ...(phones ? [PHONES_FILE] : []), ...(phones === FINAL ? [BLOCKS_FILE] : [])];
  const folder = String(base).replace(/\/?$/, "/");
  const [encoder, blob, header, phonesBlob, blocks] = await Promise.all(files.map((name) => readBytes(toUrl(name, folder))));
  const model = parseHeader(header, folder);
  if (model.format !== FORMAT) {
    throw new Error(`the models have the format ${model.format}, and this package needs ${FORMAT}; run kouxing export web again`);
  }
  const phoneArrays = phones ? unpack(phonesBlob, model.phoneArrays) : null;
  return {
    ...model,
    arrays: unpack(blob, model.arrays),
    phoneArrays,
    phoneLm: phones ? new PhoneLm(phoneArrays, model.constants) : null,
    encoder: new Network(readGraph(encoder)),
    blocks: blocks ? new Network(readGraph(blocks)) : null,
  };
}

/** Parse model.json. For a wrong address, a server may return its start page instead. */
function parseHeader(bytes, folder) {
  try {
    return JSON.parse(new TextDecoder().decode(bytes));
  } catch (error) {
    throw new Error(`${folder}model.json is not a model; set the option models to the folder that contains the models`, { cause: error });
  }
}

/** Return { shape, values } by name. */
function unpack(blob, entries) {
  return Object.fromEntries(
    Object.entries(entries).map(([name, { type, shape, begin }]) => {
      const size = shape.reduce((a, b) => a * b, 1);
      const stored = new ARRAYS[type](blob.buffer, blob.byteOffset + begin, size);
      return [name, { shape, values: type === "float16" ? floats(stored, halfToFloat) : stored }];
    }),
  );
}

function toUrl(name, folder) {
  try {
    return new URL(name, folder);
  } catch (error) {
    throw new TypeError(`models is ${folder}, which is not a URL; in Node, use pathToFileURL() of node:url`, { cause: error });
  }
}

async function readBytes(url) {
  try {
    if (url.protocol === "file:") {
      const { readFile } = await import(/* webpackIgnore: true */ "node:fs/promises");
      return new Uint8Array(new Uint8Array(await readFile(url)).buffer); // its own buffer starts at 0
    }
    const answer = await fetch(url);
    if (!answer.ok) throw new Error(`${answer.status} ${answer.statusText}`);
    return new Uint8Array(await answer.arrayBuffer());
  } catch (error) {
    throw new Error(`cannot load ${url} (${error.message}); set the option models to the folder that contains this file, or create the file with: kouxing export web`, { cause: error });
  }
}
