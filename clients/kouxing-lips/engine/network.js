// Runs a network: the nodes of a graph, for one session.
//
// Files are those that the server runs with onnxruntime. Only their operators are supported. As on the
// server, values are rounded to 32 bits after each operator. All tensors are allocated once, so a run
// leaves no garbage.
//
// onnxruntime-web is not used. It would add 3.7 MB to a download of 2.9 MB; the code here is 10 kB. A step of the
// audio encoder needs 0.3 ms here and 0.6 ms in onnxruntime-web 1.30 (Node 20, one thread, shortest of 15 series).

import { OPERATORS, tensorOf } from "./operators.js";
import { ProductMemory, alignedBytes } from "./products.js";

export class Network {
  #tensors; // { shape, values } by name
  #steps;

  /** Open a graph (readGraph); throws an error if it needs other operators. */
  constructor({ nodes, tensors, inputs }) {
    const unknown = nodes.find(({ type }) => !(type in OPERATORS));
    if (unknown) throw new Error(`the network needs the operator ${unknown.type}; update the package`);
    this.#tensors = { ...tensors };
    const stored = []; // tensors in the memory
    for (const [name, shape] of Object.entries(inputs)) stored.push((this.#tensors[name] = tensorOf(shape)));
    const starts = nodes.map((node) => {
      const { outputs, start, constants = [] } = OPERATORS[node.type](node, node.inputs.map((name) => this.#tensors[name]));
      node.outputs.forEach((name, i) => (this.#tensors[name] = outputs[i]));
      stored.push(...outputs.filter(({ values, of }) => !values && !of), ...constants);
      return start;
    });
    const memory = new ProductMemory(stored.reduce((sum, { Type = Float32Array, length }) => sum + alignedBytes(Type, length), 0));
    for (const tensor of stored) tensor.values = memory.array(tensor.Type ?? Float32Array, tensor.length);
    for (const tensor of Object.values(this.#tensors)) resolve(tensor);
    this.#steps = starts.flatMap((start) => start?.(memory) ?? []);
  }

  /** Return the values of an input or of an output, always in the same array. */
  values(name) {
    return this.#tensors[name].values;
  }

  /** Return the shape of an input or of an output. */
  shape(name) {
    return this.#tensors[name].shape;
  }

  /** Compute the outputs from the inputs. */
  run() {
    for (const step of this.#steps) step();
  }
}

/** Set the values of a tensor that is a part of another. */
function resolve(tensor) {
  if (tensor.values || !tensor.of) return;
  resolve(tensor.of);
  tensor.values = tensor.of.values.subarray(tensor.offset, tensor.offset + tensor.length);
}
