// Blendshape weights from FAPs; shared/face/shapes.py has equation (2) and the algorithm.

import { clamp } from "./math.js";

const FINISH = {
  // "sil" is 1 minus the sum of the others
  oculus(weights) {
    weights[0] = Math.max(0, 1 - weights.reduce((a, b) => a + b));
  },
  // "blink" is the part that both eyes share
  vrm(weights, names) {
    const [both, left, right] = ["blink", "blinkLeft", "blinkRight"].map((name) => names.indexOf(name));
    weights[both] = Math.min(weights[left], weights[right]);
    weights[left] -= weights[both];
    weights[right] -= weights[both];
  },
};

/** One of the sets "arkit", "oculus" and "vrm". */
export class ShapeSet {
  #gram;
  #right;
  // buffers
  #matrix;
  #solution;
  #target;
  #weights;
  #atOne; // weights that were 1 in the last solution, the first guess for the next
  #free; // weights between 0 and 1 in the last solution
  #isWrong; // weights that the next solution frees or fixes
  #finish;
  #constants;

  /** Throws an error if the set is unknown. */
  constructor(set, { arrays, shapeNames, constants }) {
    if (!(set in shapeNames)) throw new Error(`unknown shapes ${set}; use ${Object.keys(shapeNames).join(", ")}`);
    this.names = shapeNames[set];
    this.#constants = constants.shapes;
    this.#gram = rowsOf(arrays[`shapes.${set}.gram`]);
    this.#right = rowsOf(arrays[`shapes.${set}.right`]);
    this.#matrix = new Float64Array(this.names.length ** 2);
    [this.#solution, this.#target, this.#weights] = [0, 0, 0].map(() => new Float64Array(this.names.length));
    this.#atOne = new Uint8Array(this.names.length);
    this.#free = new Uint8Array(this.names.length);
    this.#isWrong = new Uint8Array(this.names.length);
    this.#finish = FINISH[set] ?? (() => {});
  }

  /** Return the weights, 0 to 1, whose face is closest to FAPs (68,). */
  weights(faps) {
    this.#right.forEach((row, i) => (this.#target[i] = dot(row, faps)));
    const weights = new Float32Array(this.#solve(this.#target));
    this.#finish(weights, this.names);
    return weights;
  }

  #solve(right) {
    const { ROUNDING, PATIENCE } = this.#constants;
    const [atOne, free, isWrong] = [this.#atOne, this.#free, this.#isWrong];
    const size = right.length;
    let [fewest, patience] = [size + 1, PATIENCE];
    for (;;) {
      const weights = this.#solveForFree(right);
      let [numWrong, lastWrong] = [0, 0];
      for (let i = 0; i < size; i++) {
        if (free[i]) isWrong[i] = weights[i] < -ROUNDING || weights[i] > 1 + ROUNDING ? 1 : 0;
        else {
          const negativeGradient = right[i] - dot(this.#gram[i], weights);
          isWrong[i] = (atOne[i] ? -negativeGradient : negativeGradient) > ROUNDING ? 1 : 0;
        }
        if (isWrong[i]) [numWrong, lastWrong] = [numWrong + 1, i];
      }
      if (numWrong === 0) {
        for (let i = 0; i < size; i++) weights[i] = clamp(weights[i], 0, 1);
        return weights;
      }
      let first = 0;
      if (numWrong < fewest) [fewest, patience] = [numWrong, PATIENCE];
      else if (patience) patience--;
      else first = lastWrong; // exchanging only the last one guarantees termination
      for (let i = first; i < size; i++) {
        if (!isWrong[i]) continue;
        atOne[i] = free[i] && weights[i] > 1 + ROUNDING ? 1 : 0;
        free[i] = free[i] ? 0 : 1;
      }
    }
  }

  /** Return weights: 0, 1, or the solution of the equations of the free shapes. */
  #solveForFree(right) {
    const [weights, free, matrix, solution] = [this.#weights, this.#free, this.#matrix, this.#solution];
    weights.set(this.#atOne);
    let [row, at] = [0, 0];
    for (let i = 0; i < free.length; i++) {
      if (!free[i]) continue;
      const equation = this.#gram[i];
      solution[row++] = right[i] - dot(equation, weights);
      for (let j = 0; j < free.length; j++) if (free[j]) matrix[at++] = equation[j];
    }
    solve(matrix, solution, row);
    row = 0;
    for (let i = 0; i < free.length; i++) if (free[i]) weights[i] = solution[row++];
    return weights;
  }
}

function rowsOf({ values, shape: [rows, columns] }) {
  return Array.from({ length: rows }, (_, row) => values.subarray(row * columns, (row + 1) * columns));
}

function dot(left, right) {
  let sum = 0;
  for (let i = 0; i < left.length; i++) sum += left[i] * right[i];
  return sum;
}

/**
 * Solve linear equations with a symmetric positive definite matrix (Cholesky), in place.
 *
 * @param matrix rows one after the other; its lower half is overwritten
 * @param right replaced by the solution
 * @param size number of equations
 */
function solve(matrix, right, size) {
  for (let i = 0; i < size; i++) {
    for (let j = 0; j <= i; j++) {
      let sum = matrix[i * size + j];
      for (let k = 0; k < j; k++) sum -= matrix[i * size + k] * matrix[j * size + k];
      matrix[i * size + j] = i === j ? Math.sqrt(sum) : sum / matrix[j * size + j];
    }
  }
  for (let i = 0; i < size; i++) {
    for (let k = 0; k < i; k++) right[i] -= matrix[i * size + k] * right[k];
    right[i] /= matrix[i * size + i];
  }
  for (let i = size - 1; i >= 0; i--) {
    for (let k = i + 1; k < size; k++) right[i] -= matrix[k * size + i] * right[k];
    right[i] /= matrix[i * size + i];
  }
}
