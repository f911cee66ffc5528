// Runs the small ear: an ONNX graph whose tensors are vectors, with products of 8-bit integers.
//
// The graph is the one that the server runs with onnxruntime. Only its operators are supported.
// As on the server, values are rounded to 32 bits after each operator. All vectors are allocated once, so a
// run leaves no garbage.

import { loadMatrices } from "./matvec.js";
import { readGraph } from "./onnx-file.js";

const PRODUCT = "MatMulIntegerToFloat";

// Each of these loops is a separate function, so that JavaScript engines compile it for its operation.
const UNARY = {
  Abs(out, x) {
    for (let i = 0; i < out.length; i++) out[i] = Math.abs(x[i]);
  },
  Relu(out, x) {
    for (let i = 0; i < out.length; i++) out[i] = Math.max(x[i], 0);
  },
  Sigmoid(out, x) {
    for (let i = 0; i < out.length; i++) out[i] = 1 / (1 + Math.exp(-x[i]));
  },
  Tanh(out, x) {
    for (let i = 0; i < out.length; i++) out[i] = Math.tanh(x[i]);
  },
};
// A single value applies to all: its step is 0.
const BINARY = {
  Add(out, x, y, xStep, yStep) {
    for (let i = 0; i < out.length; i++) out[i] = x[i * xStep] + y[i * yStep];
  },
  Sub(out, x, y, xStep, yStep) {
    for (let i = 0; i < out.length; i++) out[i] = x[i * xStep] - y[i * yStep];
  },
  Mul(out, x, y, xStep, yStep) {
    for (let i = 0; i < out.length; i++) out[i] = x[i * xStep] * y[i * yStep];
  },
  Max(out, x, y, xStep, yStep) {
    for (let i = 0; i < out.length; i++) out[i] = Math.max(x[i * xStep], y[i * yStep]);
  },
};

function unary({ type }, [x]) {
  const out = new Float32Array(x.length);
  const compute = UNARY[type];
  return { outputs: [out], run: () => compute(out, x) };
}

function binary({ type }, [x, y]) {
  const out = new Float32Array(Math.max(x.length, y.length));
  const [xStep, yStep] = [x, y].map(({ length }) => (length > 1 ? 1 : 0));
  const compute = BINARY[type];
  return { outputs: [out], run: () => compute(out, x, y, xStep, yStep) };
}

const constant = (...outputs) => ({ outputs, run() {} });

// Each takes a node and its inputs, and returns { outputs, run: computes them }.
const OPERATORS = {
  ...Object.fromEntries(Object.keys(UNARY).map((type) => [type, unary])),
  ...Object.fromEntries(Object.keys(BINARY).map((type) => [type, binary])),
  ReduceMax(_node, [x]) {
    const out = new Float32Array(1);
    return { outputs: [out], run: () => (out[0] = largest(x)) };
  },
  Unsqueeze: (_node, [x]) => constant(x),
  Shape: (_node, [x]) => constant([x.length]),
  ConstantOfShape: ({ attributes }) => constant(attributes.value),
  Concat(_node, parts) {
    const out = new Float32Array(parts.reduce((sum, { length }) => sum + length, 0));
    let at = 0;
    const places = parts.map(({ length }) => (at += length) - length);
    return { outputs: [out], run: () => parts.forEach((part, i) => out.set(part, places[i])) };
  },
  Split({ outputs }, [x, lengths]) {
    let end = 0;
    return constant(...outputs.map((_name, i) => x.subarray(end, (end += lengths?.[i] ?? x.length / outputs.length))));
  },
  QuantizeLinear(_node, [x, scale, zero]) {
    const out = new Uint8Array(x.length);
    const run = () => {
      for (let i = 0; i < out.length; i++) out[i] = clampByte(roundHalfEven(Math.fround(x[i] / scale[0])) + zero[0]);
    };
    return { outputs: [out], run };
  },
  [PRODUCT]({ matrix }, [x, , xScale, scales, zero]) {
    const values = new Int8Array(x.length);
    const out = new Float32Array(scales.length);
    const run = () => {
      for (let i = 0; i < values.length; i++) values[i] = x[i] - zero[0];
      const sums = matrix.times(values);
      for (let i = 0; i < out.length; i++) out[i] = Math.fround(xScale[0] * scales[i]) * sums[i];
    };
    return { outputs: [out], run };
  },
  Softmax(_node, [x]) {
    const out = new Float32Array(x.length);
    const run = () => {
      const most = largest(x);
      const sum = x.reduce((total, value) => total + Math.exp(value - most), 0);
      for (let i = 0; i < out.length; i++) out[i] = Math.exp(x[i] - most) / sum;
    };
    return { outputs: [out], run };
  },
  LogSoftmax(_node, [x]) {
    const out = new Float32Array(x.length);
    const run = () => {
      const most = largest(x);
      const sum = x.reduce((total, value) => total + Math.exp(value - most), 0);
      for (let i = 0; i < out.length; i++) out[i] = x[i] - most - Math.log(sum);
    };
    return { outputs: [out], run };
  },
};

function largest(values) {
  let most = -Infinity;
  for (let i = 0; i < values.length; i++) most = Math.max(most, values[i]);
  return most;
}

function clampByte(value) {
  return Math.min(255, Math.max(0, value));
}

function roundHalfEven(x) {
  const nearest = Math.round(x);
  return nearest - x === 0.5 && nearest % 2 !== 0 ? nearest - 1 : nearest;
}

export class Network {
  #values; // vectors by name
  #steps;

  /** Open the bytes of an ONNX file; throws an error if it needs other operators. */
  constructor(bytes) {
    const { nodes, tensors, inputs } = readGraph(bytes);
    const unknown = nodes.find(({ type }) => !(type in OPERATORS));
    if (unknown) throw new Error(`the network needs the operator ${unknown.type}; update the package`);
    this.#values = Object.fromEntries(Object.entries(tensors).map(([name, { values }]) => [name, values]));
    for (const [name, size] of Object.entries(inputs)) this.#values[name] = new Float32Array(size);
    const products = nodes.filter(({ type }) => type === PRODUCT);
    const matrices = loadMatrices(
      products.map(({ inputs: [, name] }) => {
        const { shape, values } = tensors[name];
        return { integers: values, rows: shape[0], columns: shape[1] };
      }),
    );
    products.forEach((node, number) => (node.matrix = matrices[number]));
    this.#steps = nodes.map((node) => {
      const { outputs, run } = OPERATORS[node.type](node, node.inputs.map((name) => this.#values[name]));
      node.outputs.forEach((name, i) => (this.#values[name] = outputs[i]));
      return run;
    });
  }

  /** Compute all values of the graph by name, vectors that are valid until the next run. */
  run(inputs) {
    for (const [name, values] of Object.entries(inputs)) this.#values[name].set(values);
    for (const step of this.#steps) step();
    return this.#values;
  }
}
