// The lip predictor; services/recognizer/lip_predictor.py has the formulas.

import { sigmoid } from "./math.js";

/** The lip frames of one session. */
export class LipPredictor {
  #weights; // arrays by name
  #constants;
  #numMouthFaps;
  #delay; // number of the used delay
  #delayS;
  #state;
  #buffers; // of a step

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
    this.#delay = delaysS.indexOf(this.#delayS);
    const { projection, entry_weights, state_weights, output_bias } = this.#weights;
    const gates = state_weights.shape[1];
    const sizes = [...projection.shape, entry_weights.shape[1], gates, gates, output_bias.shape[1]];
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
    const { COLUMNS, PAIRS, CLOSURE } = this.#constants;
    const faps = new Array(this.#numMouthFaps).fill(0);
    COLUMNS.forEach((column, i) => (faps[column] = Math.fround(outputs[i])));
    for (const [one, other] of PAIRS) faps[other] = faps[one];
    return { timeS: knownS - this.#delayS, delayS: this.#delayS, faps, closure: sigmoid(outputs[CLOSURE]) };
  }

  /** Return the outputs at the delay, from features that stay unchanged. */
  #step(features) {
    const w = this.#weights;
    const [centered, component, entered, fromInput, fromState, outputs] = this.#buffers;
    for (let i = 0; i < centered.length; i++) centered[i] = features[i] - w.feature_mean.values[i];
    times(component, centered, w.projection);
    times(entered, component, w.entry_weights, w.entry_bias);
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
    const numLips = w.lip_weights.shape[0];
    for (let output = 0; output < outputs.length; output++) {
      const weight = (array, i) => array.values[(i * array.shape[1] + this.#delay) * outputs.length + output];
      let sum = w.output_bias.values[this.#delay * outputs.length + output];
      for (let i = 0; i < numLips; i++) sum += features[features.length - numLips + i] * weight(w.lip_weights, i);
      for (let i = 0; i < size; i++) sum += this.#state[i] * weight(w.output_weights, i);
      for (let i = 0; i < size; i++) sum += entered[i] * weight(w.output_weights, size + i);
      outputs[output] = sum;
    }
    return outputs;
  }
}

/** Compute the product of a vector (rows,) and a matrix (rows, columns), plus a bias. */
function times(out, vector, { values, shape: [rows, columns] }, bias = null) {
  for (let column = 0; column < columns; column++) out[column] = bias?.values[column] ?? 0;
  for (let row = 0; row < rows; row++) {
    const factor = vector[row];
    for (let column = 0, at = row * columns; column < columns; column++, at++) out[column] += factor * values[at];
  }
}
