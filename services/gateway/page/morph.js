// Morph targets moved on the CPU.
//
// A FAP moves a few hundred to a few thousand of a mesh's vertices, but WebGL's morph targets visit
// every vertex for every target: fifty times the work, which phones and software rendering feel.
// Here each target keeps only the vertices that it moves, and the normals follow the moved surface.

const NEARLY_ZERO = 1e-7; // metres

/** Moves the vertices and normals of one mesh. */
export class MorphedMesh {
  #targets = []; // { fap, scale, vertices, deltas }
  #position;
  #normal;
  #restPosition;
  #restNormal;
  #corners; // three offsets into the positions for each triangle that can turn
  #turning; // offsets of the normals that can turn
  #sums; // the triangles' normals summed up at every vertex
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
    this.#findTurning(geometry.index.array);
    this.#sums = new Float32Array(this.#restPosition.length);
    this.#sumNormals();
    this.#restSums = this.#sums.slice();
  }

  /** Take on a face: 68 values in FAP units. */
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
    this.#turnNormals();
    this.#position.needsUpdate = true;
    this.#normal.needsUpdate = true;
  }

  /** Add the turn of the triangles to the normals of the file, which are smoother than they. */
  #turnNormals() {
    this.#sumNormals();
    const [normal, now, then] = [this.#normal.array, this.#sums, this.#restSums];
    for (const v of this.#turning) {
      const nowLength = Math.hypot(now[v], now[v + 1], now[v + 2]) || 1;
      const thenLength = Math.hypot(then[v], then[v + 1], then[v + 2]) || 1;
      for (let i = v; i < v + 3; i++) {
        normal[i] = this.#restNormal[i] + now[i] / nowLength - then[i] / thenLength;
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

  /** Find the vertices of triangles that move, and all triangles that meet there. */
  #findTurning(index) {
    const numVertices = this.#restPosition.length / 3;
    const moves = new Uint8Array(numVertices);
    const turns = new Uint8Array(numVertices);
    for (const { vertices } of this.#targets) for (const vertex of vertices) moves[vertex] = 1;
    const trianglesWith = (mark) => {
      const found = [];
      for (let t = 0; t < index.length; t += 3) {
        if (mark[index[t]] || mark[index[t + 1]] || mark[index[t + 2]]) {
          found.push(index[t], index[t + 1], index[t + 2]);
        }
      }
      return found;
    };
    for (const vertex of trianglesWith(moves)) turns[vertex] = 1;
    this.#corners = Uint32Array.from(trianglesWith(turns), (vertex) => 3 * vertex);
    const turning = [...turns.keys()].filter((vertex) => turns[vertex]);
    this.#turning = Uint32Array.from(turning, (vertex) => 3 * vertex);
  }
}

/** Return the vertices that a morph target moves, and by how much. */
function sparse(attribute) {
  const vertices = [];
  const deltas = [];
  for (let vertex = 0; vertex < attribute.count; vertex++) {
    const delta = [attribute.getX(vertex), attribute.getY(vertex), attribute.getZ(vertex)];
    if (delta.some((value) => Math.abs(value) > NEARLY_ZERO)) {
      vertices.push(vertex);
      deltas.push(...delta);
    }
  }
  return { vertices: Uint32Array.from(vertices), deltas: Float32Array.from(deltas) };
}
