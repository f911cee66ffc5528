// Meshes with fewer triangles, for drawing without a graphics card.

import * as THREE from "three";

/** Replace the triangles of a head's meshes by the coarser ones in its file. */
export async function coarsen(gltf) {
  const meshes = [];
  gltf.scene.traverse((node) => {
    if (node.userData.coarse !== undefined) meshes.push(node);
  });
  for (const { geometry, userData } of meshes) {
    const index = await gltf.parser.getDependency("accessor", userData.coarse);
    const count = 1 + index.array.reduce((max, vertex) => Math.max(max, vertex), 0);
    geometry.setIndex(index); // it uses only the first `count` vertices
    const { attributes, morphAttributes } = geometry;
    for (const name in attributes) attributes[name] = truncate(attributes[name], count);
    morphAttributes.position = morphAttributes.position?.map((target) => truncate(target, count));
  }
}

function truncate({ array, itemSize, normalized }, count) {
  return new THREE.BufferAttribute(array.subarray(0, count * itemSize), itemSize, normalized);
}
