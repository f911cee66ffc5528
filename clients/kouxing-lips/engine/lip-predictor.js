// The lip predictor; services/recognizer/lips/lip_predictor.py has the formulas.

import { sigmoid } from "./math.js";
import { ProductMemory, alignedBytes } from "./products.js";

const LANES = 4; // values that a product of floats processes together

/** The lip positions of one session. */
export class LipPredictor {
  #weights; // arrays by name
  #constants;
  #numMouthFaps;
  #delayS;
  #memory;
  #arrays; // arrays in the memory, by name

  /** @param delayS delay of the face; the longest delay of the model that fits is used */
  constructor({ arrays, constants, mouthFaps }, delayS) {
    this.#weights = Object.fromEntries(
      Object.entries(arrays).flatMap(([name, array]) => (name.startsWith("lips.") ? [[name.slice(5), array]] : [])),
    );
    this.#constants = constants.lips;
    this.#numMouthFaps = mouthFaps.length;
    const delaysS = Array.from(this.#weights.delays.values, (value) => Math.round(1e6 * value) / 1e6);
    const possibleDelaysS = delaysS.filter((delay) => delay + constants.lipPrediction.ENCODER_FRAME_LAG_S <= delayS + 1e-6);
    this.#delayS = possibleDelaysS.at(-1) ?? delaysS[0];
    const { projection, entry_weights, input_weights, state_weights, output_bias } = this.#weights;
    const entry = product(projection, entry_weights); // no activation separates these two layers
    const [numFeatures, width] = entry.shape;
    const gates = input_weights.shape[1];
    const stateAt = Math.ceil(numFeatures / LANES) * LANES;
    const numInputs = stateAt + 2 * width; // features, state and entry are the inputs of the outputs
    const numOutputs = output_bias.shape[1];
    const matrices = { entry: entry.values, input: input_weights.values, state: state_weights.values };
    const outputs = this.#outputWeights(delaysS.indexOf(this.#delayS), numOutputs, stateAt, numInputs);
    const sizes = { centered: numFeatures, inputs: numInputs, fromInput: gates, fromState: gates, outputs: numOutputs };
    const lengths = [...Object.values(sizes), ...Object.values(matrices).map(({ length }) => length), outputs.length];
    const memory = new ProductMemory(lengths.reduce((sum, length) => sum + alignedBytes(Float32Array, length), 0));
    const stored = (values) => {
      const array = memory.array(Float32Array, values.length);
      array.set(values);
      return array;
    };
    const buffers = Object.fromEntries(Object.entries(sizes).map(([name, size]) => [name, memory.array(Float32Array, size)]));
    this.#memory = memory;
    this.#arrays = {
      ...buffers,
      lastState: buffers.inputs.subarray(stateAt, stateAt + width),
      entryOutput: buffers.inputs.subarray(stateAt + width),
      weights: Object.fromEntries(Object.entries(matrices).map(([name, values]) => [name, stored(values)])),
      outputWeights: stored(outputs),
      outputBias: output_bias.values.subarray(delaysS.indexOf(this.#delayS) * numOutputs),
    };
  }

  /** Start a new segment of speech. */
  reset() {
    this.#arrays.lastState.fill(0);
  }

  /**
   * Return the lip positions that an encoder frame determines.
   *
   * @param knownS media time of the encoder frame's last sample, seconds
   * @param features two log-mel frames and the encoder's features
   * @returns { timeS, delayS, faps: of the mouth, closure: probability }
   */
  processPosition(knownS, features) {
    const outputs = this.#step(features);
    const { COLUMNS, ONES, OTHERS, CLOSURE } = this.#constants;
    const faps = new Array(this.#numMouthFaps).fill(0);
    COLUMNS.forEach((column, i) => (faps[column] = outputs[i]));
    OTHERS.forEach((other, i) => (faps[other] = faps[ONES[i]]));
    return { timeS: knownS - this.#delayS, delayS: this.#delayS, faps, closure: sigmoid(outputs[CLOSURE]) };
  }

  /** Return the outputs at the delay, from features that stay unchanged. */
  #step(features) {
    const w = this.#weights;
    const { centered, inputs, lastState, entryOutput, fromInput, fromState, outputs, weights, outputWeights, outputBias } = this.#arrays;
    const size = lastState.length;
    inputs.set(features);
    for (let i = 0; i < centered.length; i++) centered[i] = features[i] - w.feature_mean.values[i];
    this.#multiply(centered, weights.entry, entryOutput);
    for (let i = 0; i < size; i++) entryOutput[i] = Math.max(entryOutput[i] + w.entry_bias.values[i], 0);
    this.#multiply(entryOutput, weights.input, fromInput);
    this.#multiply(lastState, weights.state, fromState);
    for (let i = 0; i < fromInput.length; i++) {
      fromInput[i] += w.input_bias.values[i];
      fromState[i] += w.state_bias.values[i];
    }
    for (let i = 0; i < 2 * size; i++) fromInput[i] += fromState[i];
    this.#activate(fromInput, 0, 2 * size, 0.5, 0.5); // reset and update gates
    for (let i = 0; i < size; i++) fromInput[2 * size + i] += fromInput[i] * fromState[2 * size + i];
    this.#activate(fromInput, 2 * size, size, 1, 0);
    for (let i = 0; i < size; i++) {
      const update = fromInput[size + i];
      lastState[i] = (1 - update) * fromInput[2 * size + i] + update * lastState[i];
    }
    const places = [inputs, outputWeights, outputs].map(({ byteOffset }) => byteOffset);
    this.#memory.multiplyTransposed(...places, 1, inputs.length, outputs.length, 1);
    for (let i = 0; i < outputs.length; i++) outputs[i] += outputBias[i];
    return outputs;
  }

  #multiply(vector, matrix, out) {
    this.#memory.multiply(vector.byteOffset, matrix.byteOffset, out.byteOffset, 1, vector.length, out.length);
  }

  /** Replace a part of an array by factor * tanh(factor * x) + offset. */
  #activate(array, at, count, factor, offset) {
    const place = array.byteOffset + at * Float32Array.BYTES_PER_ELEMENT;
    this.#memory.activate(place, place, count, factor, offset);
  }

  /** Return the weights of the outputs at a delay, (outputs, inputs): of the features, the state and the entry. */
  #outputWeights(delay, numOutputs, stateAt, numInputs) {
    const weights = new Float32Array(numOutputs * numInputs);
    for (const [{ values, shape: [rows, numDelays] }, at] of [
      [this.#weights.lip_weights, 0],
      [this.#weights.output_weights, stateAt],
    ]) {
      for (let row = 0; row < rows; row++) {
        for (let output = 0; output < numOutputs; output++) {
          weights[output * numInputs + at + row] = values[(row * numDelays + delay) * numOutputs + output];
        }
      }
    }
    return weights;
  }
}

/** Return the product of two matrices. */
export function product(left, right) {
  const [rows, size, columns] = [...left.shape, right.shape[1]];
  const values = new Float32Array(rows * columns);
  const row = new Float64Array(columns);
  for (let i = 0; i < rows; i++) {
    row.fill(0);
    for (let k = 0, at = 0; k < size; k++) {
      const factor = left.values[i * size + k];
      for (let column = 0; column < columns; column++, at++) row[column] += factor * right.values[at];
    }
    values.set(row, i * columns);
  }
  return { values, shape: [rows, columns] };
}
