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
    const faps = new Float64Array(this.#numMouthFaps);
    COLUMNS.forEach((column, i) => (faps[column] = outputs[i]));
    for (const [one, other] of PAIRS) faps[other] = faps[one];
    return { timeS: knownS - this.#delayS, delayS: this.#delayS, faps, closure: sigmoid(outputs[CLOSURE]) };
  }

  #step(features) {
    const w = this.#weights;
    const centered = features.map((value, i) => value - w.feature_mean.values[i]);
    const component = times(centered, w.projection);
    const entered = plus(times(component, w.entry_weights), w.entry_bias).map((value) => Math.max(value, 0));
    const fromInput = plus(times(entered, w.input_weights), w.input_bias);
    const fromState = plus(times(this.#state, w.state_weights), w.state_bias);
    const size = this.#state.length;
    this.#state = this.#state.map((value, i) => {
      const reset = sigmoid(fromInput[i] + fromState[i]);
      const update = sigmoid(fromInput[size + i] + fromState[size + i]);
      const next = Math.tanh(fromInput[2 * size + i] + reset * fromState[2 * size + i]);
      return (1 - update) * next + update * value;
    });
    const inner = new Float32Array([...this.#state, ...entered]);
    const lips = features.subarray(features.length - w.lip_weights.shape[0]);
    const [fromLips, recurrent] = [this.#atDelay(lips, w.lip_weights), this.#atDelay(inner, w.output_weights)];
    const bias = w.output_bias.values.subarray(this.#delay * fromLips.length);
    return fromLips.map((value, i) => value + recurrent[i] + bias[i]);
  }

  /** Return the product of a vector (n,) and the part of weights (n, delays, outputs) for the delay. */
  #atDelay(vector, { values, shape: [, numDelays, numOutputs] }) {
    const out = new Float32Array(numOutputs);
    for (let output = 0; output < numOutputs; output++) {
      let sum = 0;
      for (let i = 0; i < vector.length; i++) sum += vector[i] * values[(i * numDelays + this.#delay) * numOutputs + output];
      out[output] = sum;
    }
    return out;
  }
}

/** Return the product of a vector (rows,) and a matrix. */
function times(vector, { values, shape: [rows, columns] }) {
  const sums = new Float64Array(columns);
  for (let row = 0; row < rows; row++) {
    const factor = vector[row];
    for (let column = 0, at = row * columns; column < columns; column++, at++) sums[column] += factor * values[at];
  }
  return Float32Array.from(sums);
}

function plus(vector, { values }) {
  return vector.map((value, i) => value + values[i]);
}
