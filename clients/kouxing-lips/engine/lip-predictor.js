// The lip predictor; services/recognizer/lip_predictor.py has the formulas.

import { sigmoid } from "./math.js";
import { ProductMemory, alignedBytes } from "./products.js";

/** The lip frames of one session. */
export class LipPredictor {
  #weights; // arrays by name
  #constants;
  #numMouthFaps;
  #delayS;
  #state;
  // Multiply buffers by matrices. The first multiplies those of x and u: nothing is between them.
  #enter;
  #multiplyInput;
  #multiplyState;
  #outputs; // weights at the used delay: an array for each output, and a bias
  #buffers; // buffers of a step

  /** @param delayS delay of the face; the longest delay of the model that fits is used */
  constructor({ arrays, constants, mouthFaps }, delayS) {
    this.#weights = Object.fromEntries(
      Object.entries(arrays).flatMap(([name, array]) => (name.startsWith("lips.") ? [[name.slice(5), array]] : [])),
    );
    this.#constants = constants.lips;
    this.#numMouthFaps = mouthFaps.length;
    const delaysS = Array.from(this.#weights.delays.values, (value) => Math.round(1e6 * value) / 1e6);
    const inTime = delaysS.filter((delay) => delay + constants.lipFrames.POSITION_LAG_S <= delayS + 1e-6);
    this.#delayS = inTime.at(-1) ?? delaysS[0];
    const { projection, entry_weights, input_weights, state_weights, output_bias } = this.#weights;
    this.#outputs = this.#outputsAt(delaysS.indexOf(this.#delayS));
    const matrices = [product(projection, entry_weights), input_weights, state_weights];
    const [[numFeatures, width], [, gates]] = matrices.map(({ shape }) => shape);
    const sizes = [...matrices.map(({ values }) => values.length), numFeatures, width, gates, width, gates];
    const memory = new ProductMemory(sizes.reduce((sum, size) => sum + alignedBytes(Float32Array, size), 0));
    const buffers = sizes.map((size) => memory.array(Float32Array, size));
    matrices.forEach(({ values }, i) => buffers[i].set(values));
    const [entry, input, state, centered, entered, fromInput, lastState, fromState] = buffers;
    const multiply = (vector, matrix, out) => () =>
      memory.multiply(...[vector, matrix, out].map(({ byteOffset }) => byteOffset), 1, vector.length, out.length);
    this.#enter = multiply(centered, entry, entered);
    this.#multiplyInput = multiply(entered, input, fromInput);
    this.#multiplyState = multiply(lastState, state, fromState);
    this.#state = lastState;
    this.#buffers = [centered, entered, fromInput, fromState, new Float64Array(output_bias.shape[1])];
    this.reset();
  }

  /** Start a new segment of speech. */
  reset() {
    this.#state.fill(0);
  }

  /**
   * Return the lip frame that follows from a position.
   *
   * @param knownS media time of the last sample that the position has seen, seconds
   * @param features two log-mel frames and the ear's features
   * @returns { timeS, delayS, faps: of the mouth, closure: probability }
   */
  processPosition(knownS, features) {
    const outputs = this.#step(features);
    const { COLUMNS, ONES, OTHERS, CLOSURE } = this.#constants;
    const faps = new Array(this.#numMouthFaps).fill(0);
    COLUMNS.forEach((column, i) => (faps[column] = Math.fround(outputs[i])));
    OTHERS.forEach((other, i) => (faps[other] = faps[ONES[i]]));
    return { timeS: knownS - this.#delayS, delayS: this.#delayS, faps, closure: sigmoid(outputs[CLOSURE]) };
  }

  /** Return the outputs at the delay, from features that stay unchanged. */
  #step(features) {
    const w = this.#weights;
    const [centered, entered, fromInput, fromState, outputs] = this.#buffers;
    for (let i = 0; i < centered.length; i++) centered[i] = features[i] - w.feature_mean.values[i];
    this.#enter();
    for (let i = 0; i < entered.length; i++) entered[i] = Math.max(entered[i] + w.entry_bias.values[i], 0);
    this.#multiplyInput();
    this.#multiplyState();
    for (let i = 0; i < fromInput.length; i++) {
      fromInput[i] += w.input_bias.values[i];
      fromState[i] += w.state_bias.values[i];
    }
    const size = this.#state.length;
    for (let i = 0; i < size; i++) {
      const reset = sigmoid(fromInput[i] + fromState[i]);
      const update = sigmoid(fromInput[size + i] + fromState[size + i]);
      const next = Math.tanh(fromInput[2 * size + i] + reset * fromState[2 * size + i]);
      this.#state[i] = (1 - update) * next + update * this.#state[i];
    }
    for (let output = 0; output < outputs.length; output++) {
      const { lips, state, bias } = this.#outputs[output];
      let sum = bias;
      for (let i = 0; i < lips.length; i++) sum += features[features.length - lips.length + i] * lips[i];
      for (let i = 0; i < size; i++) sum += this.#state[i] * state[i];
      for (let i = 0; i < size; i++) sum += entered[i] * state[size + i];
      outputs[output] = sum;
    }
    return outputs;
  }

  #outputsAt(delay) {
    const { lip_weights, output_weights, output_bias } = this.#weights;
    const [numDelays, numOutputs] = output_bias.shape;
    const column = ({ values, shape: [rows] }, output) =>
      Float32Array.from({ length: rows }, (_, row) => values[(row * numDelays + delay) * numOutputs + output]);
    return Array.from({ length: numOutputs }, (_, output) => ({
      lips: column(lip_weights, output),
      state: column(output_weights, output),
      bias: output_bias.values[delay * numOutputs + output],
    }));
  }
}

/** Return the product of two matrices. */
export function product(one, other) {
  const [rows, size, columns] = [...one.shape, other.shape[1]];
  const values = new Float32Array(rows * columns);
  const row = new Float64Array(columns);
  for (let i = 0; i < rows; i++) {
    row.fill(0);
    for (let k = 0, at = 0; k < size; k++) {
      const factor = one.values[i * size + k];
      for (let column = 0; column < columns; column++, at++) row[column] += factor * other.values[at];
    }
    values.set(row, i * columns);
  }
  return { values, shape: [rows, columns] };
}
