// The lip predictor; services/recognizer/lip_predictor.py has the formulas.

import { sigmoid } from "./math.js";

/** The lip frames of one session. */
export class LipPredictor {
  #weights; // arrays by name
  #constants;
  #numMouthFaps;
  #delayS;
  #state;
  #entry; // product of the matrices of x and u: nothing is between them
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
    const { projection, entry_weights, state_weights, output_bias } = this.#weights;
    this.#entry = product(projection, entry_weights);
    this.#outputs = this.#outputsAt(delaysS.indexOf(this.#delayS));
    const gates = state_weights.shape[1];
    const sizes = [...this.#entry.shape, gates, gates, output_bias.shape[1]];
    this.#buffers = sizes.map((size) => new Float64Array(size));
    this.reset();
  }

  /** Start a new segment of speech. */
  reset() {
    this.#state = new Float32Array(this.#weights.state_weights.shape[0]);
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
    times(entered, centered, this.#entry, w.entry_bias);
    for (let i = 0; i < entered.length; i++) entered[i] = Math.max(entered[i], 0);
    times(fromInput, entered, w.input_weights, w.input_bias);
    times(fromState, this.#state, w.state_weights, w.state_bias);
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
  const [rows, columns] = [one.shape[0], other.shape[1]];
  const values = new Float32Array(rows * columns);
  const row = new Float64Array(columns);
  const zeros = { values: new Float32Array(columns) };
  for (let i = 0; i < rows; i++) {
    times(row, one.values.subarray(i * one.shape[1], (i + 1) * one.shape[1]), other, zeros);
    values.set(row, i * columns);
  }
  return { values, shape: [rows, columns] };
}

/** Compute the product of a vector (rows,) and a matrix (rows, columns), plus a bias. */
function times(out, vector, { values, shape: [rows, columns] }, bias) {
  for (let column = 0; column < columns; column++) out[column] = bias.values[column];
  for (let row = 0; row < rows; row++) {
    const factor = vector[row];
    for (let column = 0, at = row * columns; column < columns; column++, at++) out[column] += factor * values[at];
  }
}
