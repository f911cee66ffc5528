import assert from "node:assert/strict";
import { readFile } from "node:fs/promises";
import test from "node:test";
import wabt from "wabt";
import { BINARY, loadMatrices } from "../engine/matvec.js";

test("the binary code is that of matvec.wat", async () => {
  const text = await readFile(new URL("../engine/matvec.wat", import.meta.url), "utf8");
  const { buffer } = (await wabt()).parseWat("matvec.wat", text, { simd: true }).toBinary({});
  assert.equal(Buffer.from(buffer).toString("base64"), BINARY);
});

test("products with matrices of any size are exact", () => {
  let seed = 1;
  const integer = () => ((seed = (seed * 48271) % 2147483647) % 255) - 127;
  const sizes = [
    [160, 448],
    [17, 3],
    [1, 1],
  ];
  const matrices = sizes.map(([rows, columns]) => ({ rows, columns, integers: Int8Array.from({ length: rows * columns }, integer) }));
  loadMatrices(matrices).forEach((matrix, number) => {
    const { rows, columns, integers } = matrices[number];
    const vector = Int8Array.from({ length: rows }, integer);
    const expected = Array.from({ length: columns }, (_, column) =>
      vector.reduce((sum, value, row) => sum + value * integers[row * columns + column], 0),
    );
    assert.deepEqual([...matrix.times(vector)], expected);
  });
});
