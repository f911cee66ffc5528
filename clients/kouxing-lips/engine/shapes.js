// Blendshape weights from FAPs; shared/face/shapes.py has equation (2) and the algorithm.

import { clamp } from "./math.js";

const FINISH = {
  // "sil" is 1 minus the sum of the others
  oculus(weights) {
    weights[0] = Math.max(0, 1 - weights.reduce((a, b) => a + b));
  },
  // "blink" has what both eyes have in common
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
  #scratch; // a matrix
  #atOne; // weights that were 1 in the last solution, the first guess for the next
  #free; // weights between 0 and 1 in the last solution
  #finish;
  #c; // constants

  /** Throws an error if the set is unknown. */
  constructor(set, { arrays, shapeNames, constants }) {
    if (!(set in shapeNames)) throw new Error(`unknown shapes ${set}; use ${Object.keys(shapeNames).join(", ")}`);
    this.names = shapeNames[set];
    this.#c = constants.shapes;
    this.#gram = rowsOf(arrays[`shapes.${set}.gram`]);
    this.#right = rowsOf(arrays[`shapes.${set}.right`]);
    this.#scratch = new Float64Array(this.names.length ** 2);
    this.#atOne = this.names.map(() => false);
    this.#free = this.names.map(() => false);
    this.#finish = FINISH[set] ?? (() => {});
  }

  /** Return the weights, 0 to 1, whose face is closest to FAPs (68,). */
  weights(faps) {
    const right = this.#right.map((row) => dot(row, faps));
    const weights = Float32Array.from(this.#solve(right));
    this.#finish(weights, this.names);
    return weights;
  }

  #solve(right) {
    const all = [...right.keys()];
    const [atOne, free] = [this.#atOne, this.#free];
    let [fewest, patience] = [right.length + 1, this.#c.PATIENCE];
    for (;;) {
      const weights = atOne.map(Number);
      const inner = all.filter((i) => free[i]);
      const solved = this.#solveFor(inner, inner.map((i) => right[i] - dot(this.#gram[i], weights)));
      inner.forEach((i, row) => (weights[i] = solved[row]));
      const moves = all.map((i) => {
        if (free[i]) return { i, isFree: false, isOne: weights[i] > 1 + this.#c.ROUNDING, isWrong: !isWithin(weights[i], this.#c.ROUNDING) };
        const negativeGradient = right[i] - dot(this.#gram[i], weights);
        return { i, isFree: true, isOne: false, isWrong: (atOne[i] ? -negativeGradient : negativeGradient) > this.#c.ROUNDING };
      });
      let wrong = moves.filter(({ isWrong }) => isWrong);
      if (wrong.length === 0) return weights.map((weight) => clamp(weight, 0, 1));
      if (wrong.length < fewest) [fewest, patience] = [wrong.length, this.#c.PATIENCE];
      else if (patience) patience--;
      else wrong = wrong.slice(-1); // exchanging only the last one guarantees termination
      for (const { i, isFree, isOne } of wrong) [free[i], atOne[i]] = [isFree, isOne];
    }
  }

  /** Solve the equations of some shapes; the right side is replaced by the solution. */
  #solveFor(shapes, right) {
    let at = 0;
    for (const i of shapes) for (const j of shapes) this.#scratch[at++] = this.#gram[i][j];
    solve(this.#scratch, right);
    return right;
  }
}

function isWithin(weight, rounding) {
  return weight >= -rounding && weight <= 1 + rounding;
}

function rowsOf({ values, shape: [rows, columns] }) {
  return Array.from({ length: rows }, (_, row) => values.subarray(row * columns, (row + 1) * columns));
}

function dot(one, other) {
  let sum = 0;
  for (let i = 0; i < one.length; i++) sum += one[i] * other[i];
  return sum;
}

/**
 * Solve linear equations with a symmetric positive definite matrix (Cholesky), in place.
 *
 * @param matrix rows one after the other; its lower half is overwritten
 * @param right replaced by the solution
 */
function solve(matrix, right) {
  const size = right.length;
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
