// The joints of a head, which FAPs turn.

import * as THREE from "three";

const RADIANS_PER_UNIT = 1e-5;
const TURN_ORDER = ["yaw", "pitch", "roll"]; // roll is applied first

/** Return the joints of a head's scene: { node, rest, turns: [[FAP index, axis]] }. */
export function findJoints(scene, faps) {
  const byNode = new Map();
  for (const { name, number, rotation } of faps) {
    if (rotation) {
      const turns = byNode.get(rotation.node) ?? [];
      const order = TURN_ORDER.findIndex((word) => name.includes(word));
      turns.push([number - 1, new THREE.Vector3(...rotation.axis), order]);
      byNode.set(rotation.node, turns);
    }
  }
  const joints = [];
  for (const [name, turns] of byNode) {
    const node = scene.getObjectByName(name);
    turns.sort((a, b) => a[2] - b[2]);
    if (node) joints.push({ node, rest: node.quaternion.clone(), turns });
  }
  return joints;
}

const turned = new THREE.Quaternion();

/** Turn joints: 68 values in FAP units. */
export function turnJoints(joints, faps) {
  for (const { node, rest, turns } of joints) {
    node.quaternion.copy(rest);
    for (const [index, axis] of turns) {
      turned.setFromAxisAngle(axis, faps[index] * RADIANS_PER_UNIT);
      node.quaternion.multiply(turned);
    }
  }
}
