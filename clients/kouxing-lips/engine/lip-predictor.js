// The lip predictor; services/recognizer/lips/lip_predictor.py has the formulas.

import { sigmoid } from "./math.js";
import { Network } from "./network.js";

// Type, outputs and inputs of each operator. The gates of the recurrent layer are in the order reset, update, new.
const NODES = [
  ["Sub", "centered", "features feature_mean"],
  ["MatMul", "projected", "centered entry_weights"],
  ["Add", "entry_sum", "projected entry_bias"],
  ["Relu", "entry", "entry_sum"],
  ["MatMul", "input_product", "entry input_weights"],
  ["Add", "from_input", "input_product input_bias"],
  ["Split", "reset_input update_input new_input", "from_input"],
  ["MatMul", "state_product", "last_state state_weights"],
  ["Add", "from_state", "state_product state_bias"],
  ["Split", "reset_state update_state new_state", "from_state"],
  ["Add", "reset_sum", "reset_input reset_state"],
  ["Sigmoid", "reset", "reset_sum"],
  ["Add", "update_sum", "update_input update_state"],
  ["Sigmoid", "update", "update_sum"],
  ["Mul", "remembered", "reset new_state"],
  ["Add", "new_sum", "new_input remembered"],
  ["Tanh", "new", "new_sum"],
  ["Sub", "difference", "last_state new"],
  ["Mul", "kept", "update difference"],
  ["Add", "state", "new kept"],
  ["Concat", "hidden", "state entry"],
  ["MatMul", "lip_product", "features lip_weights"],
  ["MatMul", "hidden_product", "hidden output_weights"],
  ["Add", "products", "lip_product hidden_product"],
  ["Add", "outputs", "products output_bias"],
].map(([type, outputs, inputs]) => ({ type, outputs: outputs.split(" "), inputs: inputs.split(" "), attributes: { axis: 1 } }));

/** The lip positions of one session. */
export class LipPredictor {
  #constants;
  #numMouthFaps;
  #delayS;
  #network;

  /** @param delayS delay of the face; the longest delay of the model that fits is used */
  constructor({ arrays, constants, mouthFaps }, delayS) {
    this.#constants = constants.lips;
    this.#numMouthFaps = mouthFaps.length;
    const delaysS = Array.from(arrays["lips.delays"].values, (value) => Math.round(1e6 * value) / 1e6);
    const possibleDelaysS = delaysS.filter((delay) => delay + constants.lipPrediction.ENCODER_FRAME_LAG_S <= delayS + 1e-6);
    this.#delayS = possibleDelaysS.at(-1) ?? delaysS[0];
    const delay = delaysS.indexOf(this.#delayS);
    const same = "feature_mean entry_bias input_weights input_bias state_weights state_bias".split(" ");
    const atDelay = "lip_weights output_weights output_bias".split(" ");
    const weights = {
      ...Object.fromEntries(same.map((name) => [name, arrays[`lips.${name}`]])),
      entry_weights: product(arrays["lips.projection"], arrays["lips.entry_weights"]), // no activation separates these two layers
      ...Object.fromEntries(atDelay.map((name) => [name, selectDelay(arrays[`lips.${name}`], delay)])),
    };
    const [numFeatures, width] = weights.entry_weights.shape;
    const shapes = Object.fromEntries(Object.entries(weights).map(([name, { shape }]) => [name, shape]));
    const inputs = { features: [1, numFeatures], last_state: [1, width], ...shapes };
    this.#network = new Network({ nodes: NODES, tensors: {}, inputs });
    for (const [name, { values }] of Object.entries(weights)) this.#network.values(name).set(values);
  }

  /** Start a new segment of speech. */
  reset() {
    this.#network.values("last_state").fill(0);
  }

  /**
   * Return the lip positions that an encoder frame determines.
   *
   * @param knownS media time of the encoder frame's last sample, seconds
   * @param features two log-mel frames and the encoder's features
   * @returns { timeS, delayS, faps: of the mouth, closure: probability }
   */
  processPosition(knownS, features) {
    this.#network.values("features").set(features);
    this.#network.run();
    this.#network.values("last_state").set(this.#network.values("state"));
    const outputs = this.#network.values("outputs");
    const { COLUMNS, ONES, OTHERS, CLOSURE } = this.#constants;
    const faps = new Array(this.#numMouthFaps).fill(0);
    COLUMNS.forEach((column, i) => (faps[column] = outputs[i]));
    OTHERS.forEach((other, i) => (faps[other] = faps[ONES[i]]));
    return { timeS: knownS - this.#delayS, delayS: this.#delayS, faps, closure: sigmoid(outputs[CLOSURE]) };
  }
}

/** Return the columns for one delay. The last two axes of the array are delays and columns. */
function selectDelay({ values, shape }, delay) {
  const [numDelays, numColumns] = shape.slice(-2);
  const selected = values.filter((_, i) => Math.floor(i / numColumns) % numDelays === delay);
  return { values: selected, shape: [selected.length / numColumns, numColumns] };
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
