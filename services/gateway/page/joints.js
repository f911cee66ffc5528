// Joints of a head that FAPs rotate.

import * as THREE from "three";

const RADIANS_PER_UNIT = 1e-5;
const ROTATION_ORDER = ["yaw", "pitch", "roll"]; // as for matrix products: roll is applied first

/** Return the joints of a head's scene: { node, rest, rotations: [[FAP index, axis]] }. */
export function findJoints(scene, faps) {
  const byNode = new Map();
  for (const { name, number, rotation } of faps) {
    if (rotation) {
      const rotations = byNode.get(rotation.node) ?? [];
      const order = ROTATION_ORDER.findIndex((word) => name.includes(word));
      rotations.push([number - 1, new THREE.Vector3(...rotation.axis), order]);
      byNode.set(rotation.node, rotations);
    }
  }
  const joints = [];
  for (const [name, rotations] of byNode) {
    const node = scene.getObjectByName(name);
    rotations.sort((a, b) => a[2] - b[2]);
    if (node) joints.push({ node, rest: node.quaternion.clone(), rotations });
  }
  return joints;
}

const rotation = new THREE.Quaternion();

/** Rotate joints for 68 values in FAP units. */
export function rotateJoints(joints, faps) {
  for (const { node, rest, rotations } of joints) {
    node.quaternion.copy(rest);
    for (const [index, axis] of rotations) {
      rotation.setFromAxisAngle(axis, faps[index] * RADIANS_PER_UNIT);
      node.quaternion.multiply(rotation);
    }
  }
}
