// Log-mel bands; services/recognizer/front_end/whisper_mel.py has the formula.

import { ProductMemory, alignedBytes } from "./products.js";

const LANES = 4; // values that a product processes together

/** Streaming: any chunking gives the same frames. */
export class LogMel {
  #size;
  #hop;
  #window;
  #floor;
  #bands; // weights of the bins from the first edge of each band
  #edges;
  #memory;
  #even; // sums and differences of the samples at equal distances from the ends
  #odd;
  #cosines; // (bins, distances)
  #sines;
  #real; // parts of the spectrum, (bins,)
  #imaginary;
  #samples = new Float32Array(0);

  constructor({ arrays, constants: { mel } }) {
    this.#size = mel.WINDOW_SAMPLES;
    this.#hop = mel.HOP_SAMPLES;
    this.#window = Float64Array.from(mel.HANN);
    this.#floor = mel.FLOOR;
    this.#edges = mel.EDGES;
    const { shape, values } = arrays["mel.bands"];
    this.#bands = mel.EDGES.map(([first, end], band) =>
      Float64Array.from({ length: end - first }, (_, i) => values[(first + i) * shape[1] + band]),
    );
    const [numBins, numDistances] = [shape[0], Math.ceil(shape[0] / LANES) * LANES];
    const sizes = [numDistances, numDistances, numBins * numDistances, numBins * numDistances, numBins, numBins];
    this.#memory = new ProductMemory(sizes.reduce((sum, size) => sum + alignedBytes(Float32Array, size), 0));
    [this.#even, this.#odd, this.#cosines, this.#sines, this.#real, this.#imaginary] = sizes.map((size) =>
      this.#memory.array(Float32Array, size),
    );
    for (let i = 0; i < this.#cosines.length; i++) {
      const phase = (2 * Math.PI * Math.floor(i / numDistances) * (i % numDistances)) / this.#size;
      [this.#cosines[i], this.#sines[i]] = [Math.cos(phase), Math.sin(phase)];
    }
  }

  /** Accept samples at 16 kHz, in [-1, 1]; return the new feature frames. */
  accept(samples) {
    const known = new Float32Array(this.#samples.length + samples.length);
    known.set(this.#samples);
    known.set(samples, this.#samples.length);
    const frames = [];
    let begin = 0;
    for (; begin + this.#size <= known.length; begin += this.#hop) {
      frames.push(this.#bandsOf(this.#powerSpectrum(known.subarray(begin, begin + this.#size))));
    }
    this.#samples = known.slice(begin);
    return frames;
  }

  #bandsOf(powers) {
    const bands = new Float32Array(this.#edges.length);
    for (let band = 0; band < bands.length; band++) {
      const [weights, first] = [this.#bands[band], this.#edges[band][0]];
      let total = 0;
      for (let i = 0; i < weights.length; i++) total += weights[i] * powers[first + i];
      bands[band] = (Math.log10(Math.max(total, this.#floor)) + 4) / 4;
    }
    return bands;
  }

  #powerSpectrum(samples) {
    const [size, half, window] = [this.#size, this.#size / 2, this.#window];
    for (let i = 0; i <= half; i++) {
      const first = window[i] * samples[i];
      const last = i % half ? window[size - i] * samples[size - i] : 0;
      [this.#even[i], this.#odd[i]] = [first + last, first - last];
    }
    this.#multiply(this.#even, this.#cosines, this.#real);
    this.#multiply(this.#odd, this.#sines, this.#imaginary);
    return this.#real.map((real, bin) => real ** 2 + this.#imaginary[bin] ** 2);
  }

  #multiply(vector, matrix, out) {
    this.#memory.multiplyTransposed(vector.byteOffset, matrix.byteOffset, out.byteOffset, 1, vector.length, out.length, 1);
  }
}
