// The region of an avatar's face: the vertices that its shapes move.

import * as THREE from "three";

const MIN_FRACTION = 0.1; // fraction of the largest displacement; vertices that move less are not in the region
const MAX_HEAD = 3; // height of a head, relative to the region from chin to brows
const MAX_NECK = 0.9; // part of a head below its chin, relative to the same region
const MAX_TALL = 2; // height of a head whose mesh also has a body, relative to the same region
const MAX_TALL_OF_MOUTH = 5; // the same, relative to the region of shapes that move only the mouth
const MAX_TILT = 0.17; // angle between the eyes and the x axis that is not corrected
const MAX_APART = 2; // distance of the parts of one face, in sizes of a part
const STEEPER = 1.5; // how much farther the mouth is below the eyes along an axis that replaces y

export class FaceRegion {
  #parts; // { shape, mesh, box: moved vertices }

  /**
   * Throws an error if there are several faces.
   *
   * @param targets entries { mesh, index, shape } of the morph targets
   */
  constructor(targets) {
    this.#parts = targets.map(({ mesh, index, shape }) => ({ shape, mesh, box: movedBox(mesh, index) }));
    this.#parts = this.#parts.filter(({ box }) => !box.isEmpty());
    const mouths = this.#parts.filter(({ shape }) => shape === "jawOpen" || shape === "aa");
    const size = Math.max(0, ...mouths.map(({ box }) => sizeOf(box).length()));
    const centers = new THREE.Box3().setFromPoints(mouths.map(({ box }) => centerOf(box)));
    if (sizeOf(centers).length() > MAX_APART * size) {
      throw new Error("it has several faces; export only one avatar");
    }
  }

  /** The rotation after which y is up and the face looks along z; it also undoes a mirroring. */
  get upright() {
    const [left, right, mouth] = [/^eyeBlinkLeft|^blinkLeft/, /^eyeBlinkRight|^blinkRight/, /^jawOpen|^aa/].map((name) =>
      centerOf(this.#union(({ shape }) => name.test(shape))),
    );
    const side = left.clone().sub(right);
    const up = left.add(right).divideScalar(2).sub(mouth);
    const turn = new THREE.Matrix4();
    if (![...side, ...up].every(Number.isFinite) || side.length() === 0) return turn;
    const largest = (vector) => [0, 1, 2].reduce((a, b) => (Math.abs(vector.getComponent(b)) > Math.abs(vector.getComponent(a)) ? b : a));
    const x = largest(side);
    let y = x === 1 ? 2 : 1;
    const other = 3 - x - y;
    if (Math.abs(up.getComponent(other)) > STEEPER * Math.abs(up.getComponent(y))) y = other;
    const xAxis = new THREE.Vector3().setComponent(x, Math.sign(side.getComponent(x)));
    const yAxis = new THREE.Vector3().setComponent(y, up.getComponent(y) < 0 ? -1 : 1);
    const zAxis = xAxis.clone().cross(yAxis);
    if (this.#parts.some(({ shape, mesh }) => isMouth(shape) && mesh.matrixWorld.determinant() < 0)) zAxis.negate();
    turn.makeBasis(xAxis, yAxis, zAxis).invert();
    const [current, target] = [side.applyMatrix4(turn).normalize(), new THREE.Vector3(1, 0, 0)];
    if (current.angleTo(target) < MAX_TILT) return turn;
    return turn.premultiply(new THREE.Matrix4().makeRotationFromQuaternion(new THREE.Quaternion().setFromUnitVectors(current, target)));
  }

  /** The head: { center, height }. A mesh that also has a body counts only above the chin. */
  get bounds() {
    const moved = this.#union(() => true);
    const whole = new THREE.Box3();
    for (const mesh of new Set(this.#parts.map((part) => part.mesh))) whole.expandByObject(mesh);
    const height = sizeOf(moved).y;
    const isMouthOnly = this.#parts.every(({ shape }) => isMouth(shape));
    const neck = isMouthOnly ? 0 : moved.min.y - whole.min.y; // or the body of a figure with a large head
    if (height === 0 || (sizeOf(whole).y <= MAX_HEAD * height && neck <= MAX_NECK * height)) {
      return { center: centerOf(whole), height: sizeOf(whole).y };
    }
    const limit = isMouthOnly ? MAX_TALL_OF_MOUTH : MAX_TALL;
    const center = centerOf(moved);
    moved.max.y = Math.min(whole.max.y, moved.min.y + limit * height);
    center.y = centerOf(moved).y;
    return { center, height: sizeOf(moved).y };
  }

  #union(isIncluded) {
    return this.#parts.filter(isIncluded).reduce((union, { box }) => union.union(box), new THREE.Box3());
  }
}

function isMouth(shape) {
  return !/eye|brow|cheek|nose|blink|look/.test(shape);
}

function centerOf(box) {
  return box.getCenter(new THREE.Vector3());
}

function sizeOf(box) {
  return box.getSize(new THREE.Vector3());
}

/** Return the box of the vertices that a morph target moves, in the scene's axes. */
function movedBox(mesh, index) {
  const shift = mesh.geometry.morphAttributes.position[index];
  const squares = Float32Array.from({ length: shift.count }, (_, v) => shift.getX(v) ** 2 + shift.getY(v) ** 2 + shift.getZ(v) ** 2);
  const largest = squares.reduce((a, b) => Math.max(a, b), 0);
  const box = new THREE.Box3();
  const point = new THREE.Vector3();
  squares.forEach((square, v) => {
    if (square > 0 && square >= MIN_FRACTION ** 2 * largest) {
      box.expandByPoint(mesh.getVertexPosition(v, point).applyMatrix4(mesh.matrixWorld));
    }
  });
  return box;
}
