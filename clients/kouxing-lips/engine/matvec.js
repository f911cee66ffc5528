// Products of matrices of 8-bit integers and a vector, in WebAssembly with SIMD.

const BLOCK = 16; // values that the code processes together
const PAGE_BYTES = 65536;
// matvec.wat in binary form; tests/matvec.test.mjs compares the two
export const BINARY =
  "AGFzbQEAAAABCQFgBX9/f39/AAIPAQNlbnYGbWVtb3J5AgABAwIBAAcKAQZtYXR2ZWMAAAqjAQGgAQIDfwN7IAAgA2ohBiACIARBAnRqIQcDQP0MAAAAAAAAAAAAAAAA" +
  "AAAAACEIIAAhBQNAIAX9AAQAIQkgAf0ABAAhCiAIIAkgCv2cAf1+IAkgCv2dAf1+/a4B/a4BIQggAUEQaiEBIAVBEGohBSAFIAZJDQALIAIgCP0bACAI/RsBaiAI/RsC" +
  "IAj9GwNqajYCACACQQRqIQIgAiAHSQ0ACws=";

/** Return the matrices as objects with a method times(vector). All of them share one memory. */
export function loadMatrices(matrices) {
  const sizes = matrices.map(({ rows }) => Math.ceil(rows / BLOCK) * BLOCK);
  const largest = (numbers) => numbers.reduce((a, b) => Math.max(a, b), 0);
  const values = 0;
  const sums = largest(sizes);
  let end = sums + 4 * Math.ceil(largest(matrices.map(({ columns }) => columns)) / BLOCK) * BLOCK;
  const places = matrices.map(({ columns }, number) => {
    const place = end;
    end += sizes[number] * columns;
    return place;
  });
  const memory = new WebAssembly.Memory({ initial: Math.ceil(end / PAGE_BYTES) });
  const code = Uint8Array.from(atob(BINARY), (character) => character.charCodeAt(0));
  const { matvec } = new WebAssembly.Instance(new WebAssembly.Module(code), { env: { memory } }).exports;
  return matrices.map(({ integers, rows, columns }, number) => {
    const [size, weights] = [sizes[number], places[number]];
    const transposed = new Int8Array(memory.buffer, weights, size * columns);
    for (let row = 0; row < rows; row++) {
      for (let column = 0; column < columns; column++) transposed[column * size + row] = integers[row * columns + column];
    }
    const input = new Int8Array(memory.buffer, values, size);
    const output = new Int32Array(memory.buffer, sums, columns);
    return {
      /** Return the product of int8 values (rows,) and the matrix (rows, columns), valid until the next call. */
      times(vector) {
        input.set(vector);
        input.fill(0, rows);
        matvec(values, weights, sums, size, columns);
        return output;
      },
    };
  });
}
