// Morph targets on the CPU.
//
// A FAP moves a few hundred to a few thousand vertices of a mesh. WebGL's morph targets process every
// vertex for every target. This is fifty times the work and slows down phones and software rendering.
// Here a target contains only the vertices that it moves, and the normals follow the moved surface.

const MIN_DELTA = 1e-7; // meters; smaller displacements are ignored

/** Moves the vertices and normals of one mesh. */
export class MorphedMesh {
  #targets = []; // { fap, scale, vertices, deltas }
  #position;
  #normal;
  #restPosition;
  #restNormal;
  #corners; // three offsets into the positions for each triangle that can rotate
  #rotating; // offsets of the normals that can rotate
  #sums; // sums of the triangles' normals at every vertex
  #restSums;

  /** @param mesh a three.js mesh; @param faps entries { name, number, unitsPerWeight } */
  constructor(mesh, faps) {
    const { geometry } = mesh;
    this.#position = geometry.attributes.position;
    this.#normal = geometry.attributes.normal;
    this.#restPosition = this.#position.array.slice();
    this.#restNormal = this.#normal.array.slice();
    for (const { name, number, unitsPerWeight } of faps) {
      const target = mesh.morphTargetDictionary[name];
      if (target === undefined) continue;
      const dense = geometry.morphAttributes.position[target];
      this.#targets.push({ fap: number - 1, scale: 1 / unitsPerWeight, ...sparse(dense) });
    }
    geometry.morphAttributes = {};
    mesh.morphTargetInfluences = mesh.morphTargetDictionary = undefined;
    this.#findRotating(geometry.index.array);
    this.#sums = new Float32Array(this.#restPosition.length);
    this.#sumNormals();
    this.#restSums = this.#sums.slice();
  }

  /** Move the mesh for 68 values in FAP units. */
  pose(faps) {
    const position = this.#position.array;
    position.set(this.#restPosition);
    for (const { fap, scale, vertices, deltas } of this.#targets) {
      const weight = faps[fap] * scale;
      if (weight === 0) continue;
      for (let k = 0; k < vertices.length; k++) {
        const v = 3 * vertices[k];
        position[v] += weight * deltas[3 * k];
        position[v + 1] += weight * deltas[3 * k + 1];
        position[v + 2] += weight * deltas[3 * k + 2];
      }
    }
    this.#rotateNormals();
    this.#position.needsUpdate = true;
    this.#normal.needsUpdate = true;
  }

  /** Add the rotation of the triangles to the normals of the file, which are smoother. */
  #rotateNormals() {
    this.#sumNormals();
    const [normal, sums, rest] = [this.#normal.array, this.#sums, this.#restSums];
    for (const v of this.#rotating) {
      const length = Math.hypot(sums[v], sums[v + 1], sums[v + 2]) || 1;
      const restLength = Math.hypot(rest[v], rest[v + 1], rest[v + 2]) || 1;
      for (let i = v; i < v + 3; i++) {
        normal[i] = this.#restNormal[i] + sums[i] / length - rest[i] / restLength;
      }
    }
  }

  #sumNormals() {
    const [sums, p, corners] = [this.#sums.fill(0), this.#position.array, this.#corners];
    for (let t = 0; t < corners.length; t += 3) {
      const [a, b, c] = [corners[t], corners[t + 1], corners[t + 2]];
      const ux = p[b] - p[a];
      const uy = p[b + 1] - p[a + 1];
      const uz = p[b + 2] - p[a + 2];
      const vx = p[c] - p[a];
      const vy = p[c + 1] - p[a + 1];
      const vz = p[c + 2] - p[a + 2];
      for (let corner = t; corner < t + 3; corner++) {
        const v = corners[corner];
        sums[v] += uy * vz - uz * vy;
        sums[v + 1] += uz * vx - ux * vz;
        sums[v + 2] += ux * vy - uy * vx;
      }
    }
  }

  /** Find the vertices of triangles that move, and all triangles at these vertices. */
  #findRotating(index) {
    const numVertices = this.#restPosition.length / 3;
    const moves = new Uint8Array(numVertices);
    const rotates = new Uint8Array(numVertices);
    for (const { vertices } of this.#targets) for (const vertex of vertices) moves[vertex] = 1;
    const trianglesWith = (mark) => {
      const corners = [];
      for (let t = 0; t < index.length; t += 3) {
        if (mark[index[t]] || mark[index[t + 1]] || mark[index[t + 2]]) {
          corners.push(index[t], index[t + 1], index[t + 2]);
        }
      }
      return corners;
    };
    for (const vertex of trianglesWith(moves)) rotates[vertex] = 1;
    this.#corners = Uint32Array.from(trianglesWith(rotates), (vertex) => 3 * vertex);
    const rotating = [...rotates.keys()].filter((vertex) => rotates[vertex]);
    this.#rotating = Uint32Array.from(rotating, (vertex) => 3 * vertex);
  }
}

/** Return the vertices that a morph target moves, and their displacements. */
function sparse(attribute) {
  const vertices = [];
  const deltas = [];
  for (let vertex = 0; vertex < attribute.count; vertex++) {
    const delta = [attribute.getX(vertex), attribute.getY(vertex), attribute.getZ(vertex)];
    if (delta.some((value) => Math.abs(value) > MIN_DELTA)) {
      vertices.push(vertex);
      deltas.push(...delta);
    }
  }
  return { vertices: Uint32Array.from(vertices), deltas: Float32Array.from(deltas) };
}
