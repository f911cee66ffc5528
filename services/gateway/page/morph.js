// Morph targets moved on the CPU.
//
// A FAP moves a few hundred to a few thousand of a mesh's vertices, but WebGL's morph targets visit
// every vertex for every target: fifty times the work, which phones and software rendering feel.
// Here each target keeps only the vertices that it moves, and the normals follow the moved surface.

const NEARLY_ZERO = 1e-7; // metres

/** Moves the vertices and normals of one mesh. */
export class MorphedMesh {
  #targets = []; // { fap, scale, vertices, deltas }
  #rest;
  #restNormals;
  #position;
  #normal;
  #triangles; // of the mesh, those that can move; by weld
  #corners; // the same by vertex
  #weldOf; // vertex -> one number for all vertices that differ in texture coordinates only
  #touched; // vertices whose normal can change
  #flat; // rest normals as computed here, summed by weld
  #sums;

  /** @param mesh a three.js mesh; @param faps entries { name, number, unitsPerWeight } */
  constructor(mesh, faps) {
    const geometry = mesh.geometry;
    this.#position = geometry.attributes.position;
    this.#normal = geometry.attributes.normal;
    this.#rest = this.#position.array.slice();
    this.#restNormals = this.#normal.array.slice();
    for (const { name, number, unitsPerWeight } of faps) {
      const target = mesh.morphTargetDictionary[name];
      if (target === undefined) continue;
      const dense = geometry.morphAttributes.position[target];
      this.#targets.push({ fap: number - 1, scale: 1 / unitsPerWeight, ...sparse(dense) });
    }
    geometry.morphAttributes = {};
    mesh.morphTargetInfluences = undefined;
    mesh.morphTargetDictionary = undefined;
    this.#weld(geometry.index.array);
    this.#sums = new Float32Array(3 * this.#rest.length);
    this.#flat = this.#normalSums().slice();
  }

  /** Take on a face: 68 values in FAP units. */
  pose(faps) {
    const position = this.#position.array;
    position.set(this.#rest);
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

  #turnNormals() {
    const sums = this.#normalSums();
    const normal = this.#normal.array;
    for (const vertex of this.#touched) {
      const w = 3 * this.#weldOf[vertex];
      const v = 3 * vertex;
      const now = 1 / (Math.hypot(sums[w], sums[w + 1], sums[w + 2]) || 1);
      const then = 1 / (Math.hypot(this.#flat[w], this.#flat[w + 1], this.#flat[w + 2]) || 1);
      // The change is added to the normals of the file, which may be smoother than the triangles.
      for (let axis = 0; axis < 3; axis++) {
        normal[v + axis] =
          this.#restNormals[v + axis] + sums[w + axis] * now - this.#flat[w + axis] * then;
      }
    }
  }

  /** Sum up the triangles' normals, weighted by area, at every weld. */
  #normalSums() {
    const sums = this.#sums.fill(0);
    const p = this.#position.array;
    const corners = this.#corners;
    const welds = this.#triangles;
    for (let t = 0; t < corners.length; t += 3) {
      const a = corners[t];
      const b = corners[t + 1];
      const c = corners[t + 2];
      const ux = p[b] - p[a];
      const uy = p[b + 1] - p[a + 1];
      const uz = p[b + 2] - p[a + 2];
      const vx = p[c] - p[a];
      const vy = p[c + 1] - p[a + 1];
      const vz = p[c + 2] - p[a + 2];
      const nx = uy * vz - uz * vy;
      const ny = uz * vx - ux * vz;
      const nz = ux * vy - uy * vx;
      for (let corner = t; corner < t + 3; corner++) {
        const w = welds[corner];
        sums[w] += nx;
        sums[w + 1] += ny;
        sums[w + 2] += nz;
      }
    }
    return sums;
  }

  #weld(index) {
    const numVertices = this.#rest.length / 3;
    const moves = new Uint8Array(numVertices);
    for (const { vertices } of this.#targets) for (const vertex of vertices) moves[vertex] = 1;
    this.#weldOf = new Uint32Array(numVertices);
    const known = new Map();
    for (let vertex = 0; vertex < numVertices; vertex++) {
      const at = [0, 1, 2].map((axis) => this.#rest[3 * vertex + axis].toFixed(6));
      const facing = [0, 1, 2].map((axis) => this.#restNormals[3 * vertex + axis].toFixed(1));
      const key = `${at}|${facing}`;
      if (!known.has(key)) known.set(key, vertex);
      this.#weldOf[vertex] = known.get(key);
    }
    const corners = [];
    const touched = new Set();
    // A triangle counts if it moves, or if it shares a corner with one that does.
    const near = new Uint8Array(numVertices);
    for (let t = 0; t < index.length; t += 3) {
      const corner = [index[t], index[t + 1], index[t + 2]];
      if (corner.some((vertex) => moves[vertex])) for (const vertex of corner) near[this.#weldOf[vertex]] = 1;
    }
    for (let t = 0; t < index.length; t += 3) {
      const corner = [index[t], index[t + 1], index[t + 2]];
      if (corner.some((vertex) => near[this.#weldOf[vertex]])) corners.push(...corner);
    }
    for (let vertex = 0; vertex < numVertices; vertex++) if (near[this.#weldOf[vertex]]) touched.add(vertex);
    this.#corners = Uint32Array.from(corners, (vertex) => 3 * vertex);
    this.#triangles = Uint32Array.from(corners, (vertex) => 3 * this.#weldOf[vertex]);
    this.#touched = Uint32Array.from(touched);
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
