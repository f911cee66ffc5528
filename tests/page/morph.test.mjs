import assert from "node:assert/strict";
import test from "node:test";
import { MorphedMesh } from "../../services/gateway/page/morph.js";

class Attribute {
  needsUpdate = false;
  constructor(values) {
    this.array = Float32Array.from(values);
    this.count = values.length / 3;
  }
  getX(i) { return this.array[3 * i]; }
  getY(i) { return this.array[3 * i + 1]; }
  getZ(i) { return this.array[3 * i + 2]; }
}

const REST = [0, 0, 0, 1, 0, 0, 0, 1, 0, 5, 5, 0, 6, 5, 0, 5, 6, 0];
const UP = Array(6).fill([0, 0, 1]).flat();
const JAW = { name: "jaw", number: 3, unitsPerWeight: 1000 };

/** Two triangles in a plane; the target lifts the first vertex by 1. */
function twoTriangles() {
  return {
    geometry: {
      attributes: {
        position: new Attribute(REST),
        normal: new Attribute(UP),
      },
      index: { array: [0, 1, 2, 3, 4, 5] },
      morphAttributes: { position: [new Attribute([0, 0, 1, ...Array(15).fill(0)])] },
    },
    morphTargetDictionary: { jaw: 0 },
    morphTargetInfluences: [0],
  };
}

function faceWith(value) {
  const faps = new Float32Array(68);
  faps[JAW.number - 1] = value;
  return faps;
}

test("a FAP moves only its target's vertices and normals, in proportion, and back", () => {
  const mesh = twoTriangles();
  const morphed = new MorphedMesh(mesh, [JAW]);
  const { position, normal } = mesh.geometry.attributes;
  morphed.pose(faceWith(500));
  assert.deepEqual([...position.array], [0, 0, 0.5, ...REST.slice(3)]);
  assert.ok(position.needsUpdate);
  morphed.pose(faceWith(1000));
  const third = Math.sqrt(1 / 3); // the lifted triangle's normal is (1, 1, 1) / sqrt(3)
  for (let i = 0; i < 9; i++) assert.ok(Math.abs(normal.array[i] - third) < 1e-6);
  assert.deepEqual([...normal.array.slice(9)], UP.slice(9));
  morphed.pose(faceWith(0));
  assert.deepEqual([...position.array], REST);
  assert.deepEqual([...normal.array], UP);
});
