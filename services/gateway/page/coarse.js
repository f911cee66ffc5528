// Fewer triangles, for a processor to draw.

import * as THREE from "three";

/** Give each part of a head the coarser triangles that its file has, on the first of its vertices. */
export async function coarsen(gltf) {
  const parts = [];
  gltf.scene.traverse((node) => {
    if (node.userData.coarse !== undefined) parts.push(node);
  });
  for (const { geometry, userData } of parts) {
    const index = await gltf.parser.getDependency("accessor", userData.coarse);
    const count = 1 + index.array.reduce((most, vertex) => Math.max(most, vertex), 0);
    geometry.setIndex(index);
    const { attributes, morphAttributes } = geometry;
    for (const name in attributes) attributes[name] = cut(attributes[name], count);
    morphAttributes.position = morphAttributes.position?.map((target) => cut(target, count));
  }
}

function cut({ array, itemSize, normalized }, count) {
  return new THREE.BufferAttribute(array.subarray(0, count * itemSize), itemSize, normalized);
}
