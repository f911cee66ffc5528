// Reads ONNX files: the fields of Protocol Buffers that a graph needs (onnx.proto3).
//
// No package is used, because pages load these modules without a bundler. `kouxing export web` cannot convert the
// files instead: the package onnx is not among the dependencies of kouxing.

import { halfToFloat } from "./math.js";

const FLOAT = 1;
const UINT8 = 2;
const INT8 = 3;
const INT64 = 7;
const HALF = 10;

/** Return { nodes, tensors: by name, inputs: their shapes by name } of an ONNX file, for one session. */
export function readGraph(bytes) {
  const graph = fields(bytes)[7]?.[0];
  if (!graph) throw new Error("this is not an ONNX file");
  const { 1: nodes, 5: tensors, 11: inputs } = fields(graph);
  return {
    nodes: nodes.map(readNode),
    tensors: Object.fromEntries(tensors.map((tensor) => [text(fields(tensor)[8]), readTensor(tensor)])),
    inputs: Object.fromEntries(inputs.map(readInput)),
  };
}

/** Return [name, shape] of a ValueInfoProto. An axis without a size counts the sessions. */
function readInput(bytes) {
  const inner = (value, ...path) => path.reduce((values, field) => fields(values)[field][0], value);
  const { 1: dimensions } = fields(inner(bytes, 2, 1, 2)); // type, tensor, shape
  return [text(fields(bytes)[1]), dimensions.map((dimension) => fields(dimension)[1]?.[0] ?? 1)];
}

function readNode(bytes) {
  const { 1: inputs = [], 2: outputs = [], 4: type, 5: attributes = [] } = fields(bytes);
  return {
    type: text(type),
    inputs: inputs.map(decode),
    outputs: outputs.map(decode),
    attributes: Object.fromEntries(attributes.map(readAttribute)),
  };
}

function readAttribute(bytes) {
  const { 1: name, 2: float, 3: integer, 5: tensor, 8: integers } = fields(bytes);
  return [text(name), tensor ? readTensor(tensor[0]).values : (integers && readIntegers(integers)) ?? (float ?? integer)?.[0]];
}

/** Return { shape, length, values }. */
function readTensor(bytes) {
  const { 1: dimensions = [], 2: [type], 9: [raw] = [] } = fields(bytes);
  const copy = raw?.slice().buffer;
  const shape = readIntegers(dimensions);
  const tensor = (values) => ({ shape, length: values.length, values });
  if (type === FLOAT && copy) return tensor(new Float32Array(copy));
  if (type === HALF && copy) return tensor(Float32Array.from(new Uint16Array(copy), halfToFloat));
  if (type === UINT8 && copy) return tensor(new Uint8Array(copy));
  if (type === INT8 && copy) return tensor(new Int8Array(copy));
  if (type === INT64 && copy) return tensor(Array.from(new BigInt64Array(copy), Number));
  throw new Error(`the network has tensors of type ${type}, which this package cannot read; update the package`);
}

/** Return the values of a message by field number: integers, or bytes. */
function fields(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const values = {};
  let at = 0;
  while (at < bytes.length) {
    let key;
    [key, at] = readVarint(bytes, at);
    const kind = key % 8;
    let value;
    if (kind === 0) [value, at] = readVarint(bytes, at);
    else if (kind === 1) [value, at] = [view.getFloat64(at, true), at + 8];
    else if (kind === 5) [value, at] = [view.getFloat32(at, true), at + 4];
    else if (kind === 2) {
      let length;
      [length, at] = readVarint(bytes, at);
      value = bytes.subarray(at, at + length);
      at += length;
    } else throw new Error("this is not an ONNX file");
    (values[Math.floor(key / 8)] ??= []).push(value);
  }
  return values;
}

function readVarint(bytes, at) {
  let value = 0n;
  for (let shift = 0n; ; shift += 7n) {
    const byte = bytes[at++];
    value |= BigInt(byte & 127) << shift;
    if (!(byte & 128)) return [Number(BigInt.asIntN(64, value)), at];
  }
}

/** Return the integers of a repeated field, packed or not. */
function readIntegers(field) {
  return field.flatMap((value) => (value instanceof Uint8Array ? unpackIntegers(value) : [value]));
}

function unpackIntegers(bytes) {
  const integers = [];
  for (let at = 0; at < bytes.length; ) {
    let value;
    [value, at] = readVarint(bytes, at);
    integers.push(value);
  }
  return integers;
}

function decode(bytes) {
  return new TextDecoder().decode(bytes);
}

function text(values) {
  return values ? decode(values[0]) : "";
}
