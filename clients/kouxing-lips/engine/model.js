// The files of `kouxing export web`.

import { Network } from "./network.js";

const FORMAT = "kouxing-lips 1";
const FILES = ["ear.onnx", "model.bin", "model.json"];
const ARRAYS = { float16: Uint16Array, float32: Float32Array, float64: Float64Array };

/**
 * Load the models.
 *
 * @param base URL of the folder with the files; in Node also a file URL
 * @returns a promise of { ear: Network, arrays: { values, shape } by name, constants, ... }; it is
 *   rejected if a file is missing or of another version
 */
export async function loadModel(base) {
  const [ear, blob, header] = await Promise.all(FILES.map((name) => readBytes(new URL(name, base))));
  const model = JSON.parse(new TextDecoder().decode(header));
  if (model.format !== FORMAT) {
    throw new Error(`the models have the format ${model.format}, and this package needs ${FORMAT}; export them again`);
  }
  const arrays = Object.fromEntries(
    Object.entries(model.arrays).map(([name, { type, shape, begin }]) => {
      const size = shape.reduce((a, b) => a * b, 1);
      const stored = new ARRAYS[type](blob.buffer, blob.byteOffset + begin, size);
      return [name, { shape, values: type === "float16" ? Float32Array.from(stored, halfToFloat) : stored }];
    }),
  );
  return { ...model, arrays, ear: new Network(ear) };
}

async function readBytes(url) {
  try {
    if (url.protocol === "file:") {
      const { readFile } = await import("node:fs/promises");
      return new Uint8Array(new Uint8Array(await readFile(url)).buffer); // its own buffer starts at 0
    }
    const answer = await fetch(url);
    if (!answer.ok) throw new Error(`${answer.status} ${answer.statusText}`);
    return new Uint8Array(await answer.arrayBuffer());
  } catch (error) {
    throw new Error(`cannot load ${url} (${error.message}); write it with: kouxing export web`, { cause: error });
  }
}

function halfToFloat(half) {
  const sign = half & 0x8000 ? -1 : 1;
  const exponent = (half >> 10) & 31;
  const fraction = (half & 1023) / 1024;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? (1 + fraction) * 2 ** (exponent - 15) : fraction * 2 ** -14);
}
