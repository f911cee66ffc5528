import assert from "node:assert/strict";
import { readFile } from "node:fs/promises";
import test from "node:test";
import asc from "assemblyscript/asc";
import { BINARY, ProductMemory } from "../engine/products.js";

const ENGINE = new URL("../engine/", import.meta.url);
const MEMORY_BYTES = 1 << 20;

let seed = 1;
const integer = () => ((seed = (seed * 48271) % 2147483647) % 255) - 127;
const sum = (count, term) => Array.from({ length: count }, (_, i) => term(i)).reduce((a, b) => a + b, 0);
const table = (rows, columns, value) => Array.from({ length: rows * columns }, (_, i) => value(Math.floor(i / columns), i % columns));

/** Return an array in a memory that has these values. */
function stored(memory, Type, values) {
  const array = memory.array(Type, values.length);
  array.set(values);
  return array;
}

test("the binary code equals products.ts", async () => {
  let binary;
  const options = ["products.ts", "--outFile", "binary", "--runtime", "stub", "--importMemory", "--noExportMemory", "--enable", "simd", "-O3"];
  const { error, stderr } = await asc.main(options, {
    readFile: (name) => readFile(new URL(name, ENGINE), "utf8").catch(() => null),
    writeFile: (_name, content) => (binary = content),
  });
  assert.equal(error, null, stderr.toString());
  assert.equal(Buffer.from(binary).toString("base64"), BINARY);
});

for (const [rows, size, columns] of [
  [1, 160, 448],
  [3, 16, 5],
  [2, 32, 4],
]) {
  test(`products of bytes, ${rows} x ${size} x ${columns}`, () => {
    const memory = new ProductMemory(MEMORY_BYTES);
    const x = stored(memory, Int16Array, table(rows, size, integer));
    const weights = stored(memory, Int8Array, table(columns, size, integer));
    const scales = stored(memory, Float32Array, table(1, columns, (_, column) => 2 ** -(column % 7)));
    const out = memory.array(Float32Array, rows * columns);
    memory.multiplyBytes(...[x, weights, scales, out].map(({ byteOffset }) => byteOffset), rows, size, columns);
    const expected = table(rows, columns, (row, column) => scales[column] * sum(size, (i) => x[row * size + i] * weights[column * size + i]));
    assert.deepEqual([...out], expected);
  });
}

for (const [rows, size, columns] of [
  [16, 64, 124],
  [2, 4, 17],
]) {
  test(`products of numbers, ${rows} x ${size} x ${columns}`, () => {
    const memory = new ProductMemory(MEMORY_BYTES);
    const a = stored(memory, Float32Array, table(rows, size, integer));
    const b = stored(memory, Float32Array, table(size, columns, integer));
    const transposed = stored(memory, Float32Array, table(columns, size, (column, i) => b[i * columns + column]));
    const outs = [0, 0].map(() => memory.array(Float32Array, rows * columns));
    const places = [a, b, transposed, ...outs].map(({ byteOffset }) => byteOffset);
    memory.multiply(places[0], places[1], places[3], rows, size, columns);
    memory.multiplyTransposed(places[0], places[2], places[4], rows, size, columns, 0.5);
    const expected = table(rows, columns, (row, column) => sum(size, (i) => a[row * size + i] * b[i * columns + column]));
    assert.deepEqual([...outs[0]], expected);
    assert.deepEqual([...outs[1]], expected.map((value) => value / 2));
  });
}

test("rounds half to even, and clips", () => {
  const memory = new ProductMemory(MEMORY_BYTES);
  const x = stored(memory, Float32Array, [0.5, 1.5, -0.5, -1.5, 2.4, 127.5, 999, -999, 1, 3, 5, 7, -1, -3, -5, -7]);
  const scales = stored(memory, Float32Array, [1, 2]);
  const out = memory.array(Int16Array, x.length);
  memory.quantize(x.byteOffset, scales.byteOffset, out.byteOffset, 2, 8, -128, 127);
  assert.deepEqual([...out], [0, 2, 0, -2, 2, 127, 127, -128, 0, 2, 2, 4, 0, -2, -2, -4]);
});

test("sigmoid and hyperbolic tangent", () => {
  const memory = new ProductMemory(MEMORY_BYTES);
  const values = [-30, -9, -3, -1, -0.1, 0, 1e-4, 0.5, 2, 8, 100];
  const x = stored(memory, Float32Array, values);
  for (const [factor, offset, exact] of [
    [1, 0, Math.tanh],
    [0.5, 0.5, (value) => 1 / (1 + Math.exp(-value))],
  ]) {
    const out = memory.array(Float32Array, values.length);
    memory.activate(x.byteOffset, out.byteOffset, values.length, factor, offset);
    values.forEach((value, i) => assert.ok(Math.abs(out[i] - exact(value)) < 2e-7, `${value}: ${out[i]}`));
  }
});

for (const [phases, up] of [
  [3, 3],
  [2, 3],
]) {
  test(`filters at fractional positions, with ${phases} of ${up} phases`, () => {
    const memory = new ProductMemory(MEMORY_BYTES);
    const [size, down, first, count] = [8, 4, 2, 5];
    const x = stored(memory, Float32Array, table(1, 32, integer));
    const filters = stored(memory, Float32Array, table(phases + 1, size, integer));
    const out = memory.array(Float32Array, count);
    memory.resample(...[x, filters, out].map(({ byteOffset }) => byteOffset), count, size, phases, up, down, first);
    const expected = table(1, count, (_, i) => {
      const begin = Math.floor((first + i * down) / up);
      const phase = (((first + i * down) % up) * phases) / up;
      const row = Math.floor(phase);
      const filtered = (offset) => sum(size, (tap) => x[begin + tap] * filters[(row + offset) * size + tap]);
      return filtered(0) + (phase - row) * (filtered(1) - filtered(0));
    });
    expected.forEach((value, i) => assert.ok(Math.abs(out[i] - value) <= 1e-6 * Math.abs(value), `${value}: ${out[i]}`));
  });
}
