// The operators of the networks (https://onnx.ai/onnx/operators).
//
// Each takes a node and its inputs. It returns { outputs, start, constants }: tensors, a function that
// returns the computation once all tensors have their place in a ProductMemory, and more tensors to store.
// A tensor is { shape, length, values }. A view of another tensor is { shape, length, of, offset }.

const LANES = 16; // values that products of 8-bit integers process together
const MAX_BYTE = 255;
const ROUNDER = 1.5 * 2 ** 52;
const GELU_STEPS = 512; // per unit of the table
const GELU_END = 6; // from there on, gelu(x) is x to 32 bits

// Each of these loops is a separate function, so that JavaScript engines compile it for its operation.
const UNARY = {
  Abs(out, x) {
    for (let i = 0; i < out.length; i++) out[i] = Math.abs(x[i]);
  },
  Relu(out, x) {
    for (let i = 0; i < out.length; i++) out[i] = x[i] > 0 ? x[i] : 0;
  },
  Gelu(out, x) {
    for (let i = 0; i < out.length; i++) {
      const value = x[i];
      const place = (value + GELU_END) * GELU_STEPS;
      const before = place | 0;
      if (place <= 0) out[i] = 0;
      else if (before >= GELU_TABLE.length - 1) out[i] = value;
      else out[i] = GELU_TABLE[before] + (place - before) * (GELU_TABLE[before + 1] - GELU_TABLE[before]);
    }
  },
};
// A row of the result has `count` values from `at` on. A step is 0 if one value applies to all.
const BINARY = {
  Add(out, at, count, x, xAt, xStep, y, yAt, yStep) {
    for (let i = 0; i < count; i++) out[at + i] = x[xAt + i * xStep] + y[yAt + i * yStep];
  },
  Sub(out, at, count, x, xAt, xStep, y, yAt, yStep) {
    for (let i = 0; i < count; i++) out[at + i] = x[xAt + i * xStep] - y[yAt + i * yStep];
  },
  Mul(out, at, count, x, xAt, xStep, y, yAt, yStep) {
    for (let i = 0; i < count; i++) out[at + i] = x[xAt + i * xStep] * y[yAt + i * yStep];
  },
  Max(out, at, count, x, xAt, xStep, y, yAt, yStep) {
    for (let i = 0; i < count; i++) {
      const left = x[xAt + i * xStep];
      const right = y[yAt + i * yStep];
      out[at + i] = left > right ? left : right;
    }
  },
  Less(out, at, count, x, xAt, xStep, y, yAt, yStep) {
    for (let i = 0; i < count; i++) out[at + i] = x[xAt + i * xStep] < y[yAt + i * yStep] ? 1 : 0;
  },
};

/** Return an operation whose output has the given shape. compute(values, memory) fills in its values. */
function createOperation(shape, compute) {
  const out = tensorOf(shape);
  return { outputs: [out], start: (memory) => () => compute(out.values, memory) };
}

function unary({ type }, [x]) {
  const compute = UNARY[type];
  return createOperation(x.shape, (out) => compute(out, x.values));
}

/** Return the operator that computes factor * tanh(factor * x) + offset. */
function activation(factor, offset) {
  return (_node, [x]) =>
    createOperation(x.shape, (out, memory) => memory.activate(byteOffsetOf(x), out.byteOffset, out.length, factor, offset));
}

function binary({ type }, [x, y]) {
  const outShape = broadcastShape(x.shape, y.shape);
  const compute = BINARY[type];
  const count = outShape.at(-1) ?? 1;
  const [xRows, yRows] = [x, y].map(({ shape }) => rowsOf(shape, outShape));
  return createOperation(outShape, (out) => {
    for (let row = 0; row < xRows.starts.length; row++) {
      compute(out, row * count, count, x.values, xRows.starts[row], xRows.step, y.values, yRows.starts[row], yRows.step);
    }
  });
}

/** Return the operator that computes each row of the last axis by a function (out, x, at, end). */
function rowwise(compute) {
  return (_node, [x]) => {
    const count = x.shape.at(-1);
    return createOperation(x.shape, (out) => {
      for (let at = 0; at < out.length; at += count) compute(out, x.values, at, at + count);
    });
  };
}

export const OPERATORS = {
  ...Object.fromEntries(Object.keys(UNARY).map((type) => [type, unary])),
  ...Object.fromEntries(Object.keys(BINARY).map((type) => [type, binary])),
  Sigmoid: activation(0.5, 0.5),
  Tanh: activation(1, 0),
  Softmax: rowwise((out, x, at, end) => {
    const max = maximum(x, at, end);
    let sum = 0;
    for (let i = at; i < end; i++) sum += out[i] = Math.exp(x[i] - max);
    for (let i = at; i < end; i++) out[i] /= sum;
  }),
  LogSoftmax: rowwise((out, x, at, end) => {
    const max = maximum(x, at, end);
    let sum = 0;
    for (let i = at; i < end; i++) sum += Math.exp(x[i] - max);
    for (let i = at; i < end; i++) out[i] = x[i] - max - Math.log(sum);
  }),
  ReduceMax(_node, [x]) {
    const count = x.shape.at(-1);
    return createOperation(x.shape.slice(0, -1), (out) => {
      for (let row = 0; row < out.length; row++) out[row] = maximum(x.values, row * count, (row + 1) * count);
    });
  },
  LayerNormalization({ attributes: { epsilon } }, [x, weight, bias]) {
    const normalize = rowwise((out, values, at, end) => {
      let [sum, squares] = [0, 0];
      for (let i = at; i < end; i++) sum += values[i];
      const mean = sum / (end - at);
      for (let i = at; i < end; i++) squares += (values[i] - mean) ** 2;
      const factor = 1 / Math.sqrt(squares / (end - at) + epsilon);
      for (let i = at; i < end; i++) out[i] = (values[i] - mean) * factor * weight.values[i - at] + bias.values[i - at];
    });
    return normalize(null, [x]);
  },
  Clip: (_node, [x, lowest, highest]) =>
    createOperation(x.shape, (out) => {
      for (let i = 0; i < out.length; i++) out[i] = Math.min(Math.max(x.values[i], lowest.values[0]), highest.values[0]);
    }),
  Where: (_node, [condition, yes, no]) =>
    createOperation(condition.shape, (out) => {
      for (let i = 0; i < out.length; i++) out[i] = condition.values[i] ? yes.values[0] : no.values[0];
    }),
  Unsqueeze: (_node, [x, { values: axes }]) => {
    const shape = [...x.shape];
    for (const axis of axes) shape.splice(axis < 0 ? shape.length + 1 + axis : axis, 0, 1);
    return { outputs: [viewOf(x, shape)] };
  },
  Reshape: (_node, [x, { values: sizes }]) => {
    const known = sizes.reduce((product, size) => (size < 0 ? product : product * size), 1);
    return { outputs: [viewOf(x, sizes.map((size) => (size < 0 ? x.length / known : size)))] };
  },
  // values are stored as 32-bit numbers, rounded to the type
  Cast({ attributes: { to } }, [x]) {
    return to === HALF ? createOperation(x.shape, (out) => roundToHalf(out, x.values)) : { outputs: [viewOf(x, x.shape)] };
  },
  Shape: (_node, [x]) => ({ outputs: [constant([x.shape.length], x.shape)] }),
  ConstantOfShape: ({ attributes: { value } }, [{ values: shape }]) => ({
    outputs: [constant(shape, new Array(shape.reduce((a, b) => a * b, 1)).fill(value[0]))],
  }),
  Concat({ attributes: { axis } }, parts) {
    const at = axis < 0 ? parts[0].shape.length + axis : axis;
    const shape = parts[0].shape.with(at, parts.reduce((sum, part) => sum + part.shape[at], 0));
    const inner = shape.slice(at + 1).reduce((a, b) => a * b, 1);
    const period = shape[at] * inner;
    let begin = 0;
    const places = parts.map((part) => ({ begin: (begin += part.shape[at] * inner) - part.shape[at] * inner, count: part.shape[at] * inner }));
    return createOperation(shape, (out) =>
      places.forEach(({ begin: first, count }, i) => {
        const { values } = parts[i];
        for (let from = 0, to = first; from < values.length; from += count, to += period) {
          for (let k = 0; k < count; k++) out[to + k] = values[from + k];
        }
      }),
    );
  },
  Split({ attributes: { axis }, outputs }, [x, lengths]) {
    const at = axis === undefined ? 0 : axis < 0 ? x.shape.length + axis : axis;
    let begin = 0;
    return joinOperations(
      outputs.map((_name, i) => {
        const length = lengths?.values[i] ?? x.shape[at] / outputs.length;
        begin += length;
        return sliceAxis(x, at, begin - length, begin, 1);
      }),
    );
  },
  Slice(_node, [x, begin, end, axis, step]) {
    const size = x.shape[axis.values[0]];
    const inside = (value) => Math.min(value < 0 ? value + size : value, size);
    return sliceAxis(x, axis.values[0], inside(begin.values[0]), inside(end.values[0]), step?.values[0] ?? 1);
  },
  Gather({ attributes: { axis } }, [x, { values: [place] }]) {
    const { outputs: [row], start } = sliceAxis(x, axis, place, place + 1, 1);
    return { outputs: [viewOf(row, row.shape.toSpliced(axis, 1)), row], start };
  },
  Transpose({ attributes: { perm } }, [x]) {
    const shape = perm.map((axis) => x.shape[axis]);
    const strides = stridesOf(x.shape);
    return gather(x, shape, perm.map((axis) => strides[axis]), 0);
  },
  QuantizeLinear(_node, [x, scale, zero]) {
    const [rows, size] = [scale.length, x.length / scale.length];
    if (size % LANES) throw new Error(`the network has rows of ${size} values, which is not a multiple of ${LANES}`);
    const out = { shape: x.shape, rows, size, length: x.length, Type: Int16Array }; // without the zero point
    const start = (memory) => {
      const places = [x, scale, out].map(byteOffsetOf);
      return () => memory.quantize(...places, rows, size, -zero.values[0], MAX_BYTE - zero.values[0]);
    };
    return { outputs: [out], start };
  },
  MatMulIntegerToFloat(_node, [x, weights, xScale, columnScales]) {
    const [size, columns] = weights.shape;
    const out = tensorOf([...x.shape.slice(0, -1), columns]);
    const matrix = { length: columns * size, Type: Int8Array };
    const scales = tensorOf([columns]);
    const start = (memory) => {
      for (let row = 0; row < size; row++) {
        for (let column = 0; column < columns; column++) matrix.values[column * size + row] = weights.values[row * columns + column];
      }
      weights.values = null; // frees the copy from the file
      for (let column = 0; column < columns; column++) scales.values[column] = xScale.values[0] * columnScales.values[column];
      const places = [x, matrix, scales, out].map(byteOffsetOf);
      return () => memory.multiplyBytes(...places, x.rows, size, columns);
    };
    return { outputs: [out], constants: [matrix, scales], start };
  },
  FusedMatMul: ({ attributes: { alpha } }, [x, y]) => multiplyEach(x, y, y.shape.at(-2), (memory, places, rows, size, columns) =>
    memory.multiplyTransposed(...places, rows, size, columns, alpha),
  ),
  MatMul: (_node, [x, y]) => multiplyEach(x, y, y.shape.at(-1), (memory, places, rows, size, columns) =>
    memory.multiply(...places, rows, size, columns),
  ),
  GRU,
};

/** Multiply the matrices of two tensors one by one. */
function multiplyEach(x, y, columns, multiply) {
  const [rows, size] = x.shape.slice(-2);
  const out = tensorOf([...x.shape.slice(0, -1), columns]);
  const start = (memory) => {
    const bytes = Float32Array.BYTES_PER_ELEMENT;
    const matrixOffsets = Array.from({ length: x.length / rows / size }, (_, i) => [
      byteOffsetOf(x) + i * rows * size * bytes,
      byteOffsetOf(y) + i * size * columns * bytes,
      byteOffsetOf(out) + i * rows * columns * bytes,
    ]);
    return () => {
      for (const places of matrixOffsets) multiply(memory, places, rows, size, columns);
    };
  };
  return { outputs: [out], start };
}

/**
 * Gated recurrent units in both directions, with linear_before_reset. Only the first session is computed:
 * the network repeats it, because onnxruntime is faster with two.
 */
function GRU({ attributes: { hidden_size: width } }, [x, inputWeights, stateWeights, biases, lengths, first]) {
  const [numSteps, numSessions, size] = x.shape;
  const out = tensorOf([numSteps, 2, numSessions, width]);
  const [input, fromInput, state, fromState] = [numSteps * size, numSteps * 3 * width, width, 3 * width].map((length) => tensorOf([length]));
  const weights = [inputWeights, stateWeights].map(({ length }) => tensorOf([length]));
  const start = (memory) => {
    weights[0].values.set(inputWeights.values);
    weights[1].values.set(stateWeights.values);
    const bytes = Float32Array.BYTES_PER_ELEMENT;
    return () => {
      const numPositions = lengths.values[0];
      out.values.fill(0);
      for (let step = 0; step < numPositions; step++) {
        for (let i = 0; i < size; i++) input.values[step * size + i] = x.values[step * numSessions * size + i];
      }
      for (let direction = 0; direction < 2; direction++) {
        const [places, statePlaces] = [size, width].map((length, i) => byteOffsetOf(weights[i]) + direction * 3 * width * length * bytes);
        memory.multiplyTransposed(byteOffsetOf(input), places, byteOffsetOf(fromInput), numPositions, size, 3 * width, 1);
        for (let i = 0; i < width; i++) state.values[i] = first.values[direction * numSessions * width + i];
        for (let number = 0; number < numPositions; number++) {
          const step = direction ? numPositions - 1 - number : number;
          memory.multiplyTransposed(byteOffsetOf(state), statePlaces, byteOffsetOf(fromState), 1, width, 3 * width, 1);
          advance(state.values, fromInput.values, step * 3 * width, fromState.values, biases.values, direction * 6 * width);
          const to = (step * 2 + direction) * numSessions * width;
          for (let i = 0; i < width; i++) out.values[to + i] = state.values[i];
        }
      }
    };
  };
  return { outputs: [out], constants: [input, fromInput, state, fromState, ...weights], start };
}

/** Advance the state of gated recurrent units; gates are in the order update, reset, new. */
function advance(state, input, at, hidden, bias, biasAt) {
  const width = state.length;
  const gate = (i) => 1 / (1 + Math.exp(-(input[at + i] + hidden[i] + bias[biasAt + i] + bias[biasAt + 3 * width + i])));
  for (let i = 0; i < width; i++) {
    const update = gate(i);
    const reset = gate(width + i);
    const candidate = Math.tanh(
      input[at + 2 * width + i] + bias[biasAt + 2 * width + i] + reset * (hidden[2 * width + i] + bias[biasAt + 5 * width + i]),
    );
    state[i] = (1 - update) * candidate + update * state[i];
  }
}

const HALF = 10; // type of tensors

/** Round to 16-bit floating point numbers, half to even. */
function roundToHalf(out, x) {
  for (let i = 0; i < out.length; i++) {
    const size = Math.abs(x[i]);
    const unit = 2 ** Math.max(Math.floor(Math.log2(size || 1)) - 10, -24);
    out[i] = Math.sign(x[i]) * Math.min(roundHalfEven(size / unit) * unit, 65504);
  }
}

/** Round half to even: the sum with the constant has no fraction bits. */
function roundHalfEven(x) {
  return x + ROUNDER - ROUNDER;
}

function maximum(values, at, end) {
  let max = -Infinity;
  for (let i = at; i < end; i++) if (values[i] > max) max = values[i];
  return max;
}

const GELU_TABLE = Float32Array.from({ length: 2 * GELU_END * GELU_STEPS + 1 }, (_, i) => {
  const x = i / GELU_STEPS - GELU_END;
  return (x / 2) * (1 + erf(x / Math.SQRT2));
});

/** Return the error function, by its power series and, far from 0, its continued fraction. */
function erf(x) {
  if (x < 0) return -erf(-x);
  if (x < 3) {
    let [sum, term] = [x, x];
    for (let k = 1; Math.abs(term) > 1e-17; k++) {
      term *= (-x * x) / k;
      sum += term / (2 * k + 1);
    }
    return (2 / Math.sqrt(Math.PI)) * sum;
  }
  let fraction = x;
  for (let k = 40; k > 0; k--) fraction = x + k / 2 / fraction;
  return 1 - Math.exp(-x * x) / Math.sqrt(Math.PI) / fraction;
}

/** Return a tensor without memory, which is allocated later. */
export function tensorOf(shape) {
  return { shape, length: shape.reduce((a, b) => a * b, 1), values: null };
}

function constant(shape, values) {
  return { shape, length: values.length, values };
}

function viewOf(of, shape, offset = 0) {
  const length = shape.reduce((a, b) => a * b, 1);
  return { shape, length, of, offset, values: of.values?.slice(offset, offset + length) ?? null };
}

function byteOffsetOf({ values }) {
  return values.byteOffset;
}

function stridesOf(shape) {
  const strides = new Array(shape.length).fill(1);
  for (let axis = shape.length - 2; axis >= 0; axis--) strides[axis] = strides[axis + 1] * shape[axis + 1];
  return strides;
}

function broadcastShape(left, right) {
  const length = Math.max(left.length, right.length);
  const [a, b] = [left, right].map((shape) => [...new Array(length - shape.length).fill(1), ...shape]);
  return a.map((size, axis) => Math.max(size, b[axis]));
}

/** Return where the rows of a tensor start in a broadcast shape, and the step within a row. */
function rowsOf(shape, outShape) {
  const full = [...new Array(outShape.length - shape.length).fill(1), ...shape];
  const strides = stridesOf(full).map((stride, axis) => (full[axis] === 1 ? 0 : stride));
  return { starts: offsets(outShape.slice(0, -1), strides.slice(0, -1), 0), step: strides.at(-1) ?? 0 };
}

/** Return the index of each value of a tensor, given the stride of each axis. */
function offsets(shape, strides, first) {
  let places = [first];
  shape.forEach((size, axis) => {
    places = places.flatMap((place) => Array.from({ length: size }, (_, i) => place + i * strides[axis]));
  });
  return Int32Array.from(places);
}

/** Return a range of an axis: a view of the tensor if it is contiguous, otherwise a copy. */
function sliceAxis(x, axis, begin, end, step) {
  const strides = stridesOf(x.shape);
  const shape = x.shape.with(axis, Math.ceil((end - begin) / step));
  return gather(x, shape, strides.with(axis, strides[axis] * step), begin * strides[axis]);
}

/** Return the values that the strides select: a view if they are contiguous, otherwise a copy. */
function gather(x, shape, strides, first) {
  const places = offsets(shape, strides, first);
  if (places.every((place, i) => place === first + i)) return { outputs: [viewOf(x, shape, first)] };
  return createOperation(shape, (out) => {
    const { values } = x;
    for (let i = 0; i < places.length; i++) out[i] = values[places[i]];
  });
}

/** Return one operation with the outputs of several. */
function joinOperations(operations) {
  const starts = operations.flatMap(({ start }) => start ?? []);
  return { outputs: operations.map(({ outputs: [output] }) => output), start: (memory) => starts.map((start) => start(memory)) };
}
