// Log-mel bands; services/recognizer/front_end/whisper_mel.py has the formula.

import { ProductMemory, alignedBytes } from "./products.js";

const LANES = 4; // values that a product processes together

/** Streaming: any chunking gives the same frames. */
export class LogMel {
  #size;
  #hop;
  #window;
  #floor;
  #memory;
  #even; // sums and differences of the samples at equal distances from the ends
  #odd;
  #cosines; // (bins, distances)
  #sines;
  #real; // parts of the spectrum, (bins,)
  #imaginary;
  #power; // (bins,), and zeros
  #weights; // (bands, bins and zeros)
  #sums; // (bands,)
  #samples = new Float32Array(0);

  constructor({ arrays, constants: { mel } }) {
    this.#size = mel.WINDOW_SAMPLES;
    this.#hop = mel.HOP_SAMPLES;
    this.#window = Float64Array.from(mel.HANN);
    this.#floor = mel.FLOOR;
    const { shape: [numBins, numBands], values } = arrays["mel.bands"];
    const width = Math.ceil(numBins / LANES) * LANES;
    const sizes = [width, width, numBins * width, numBins * width, numBins, numBins, width, numBands * width, numBands];
    this.#memory = new ProductMemory(sizes.reduce((sum, size) => sum + alignedBytes(Float32Array, size), 0));
    [this.#even, this.#odd, this.#cosines, this.#sines, this.#real, this.#imaginary, this.#power, this.#weights, this.#sums] =
      sizes.map((size) => this.#memory.array(Float32Array, size));
    for (let i = 0; i < this.#cosines.length; i++) {
      const phase = (2 * Math.PI * Math.floor(i / width) * (i % width)) / this.#size;
      [this.#cosines[i], this.#sines[i]] = [Math.cos(phase), Math.sin(phase)];
    }
    values.forEach((weight, i) => (this.#weights[(i % numBands) * width + Math.floor(i / numBands)] = weight));
  }

  /** Accept samples at 16 kHz, in [-1, 1]; return the new feature frames. */
  accept(samples) {
    const known = new Float32Array(this.#samples.length + samples.length);
    known.set(this.#samples);
    known.set(samples, this.#samples.length);
    const frames = [];
    let begin = 0;
    for (; begin + this.#size <= known.length; begin += this.#hop) {
      this.#computePower(known.subarray(begin, begin + this.#size));
      this.#multiply(this.#power, this.#weights, this.#sums);
      frames.push(this.#sums.map((sum) => (Math.log10(Math.max(sum, this.#floor)) + 4) / 4));
    }
    this.#samples = known.slice(begin);
    return frames;
  }

  #computePower(samples) {
    const [size, half, window] = [this.#size, this.#size / 2, this.#window];
    for (let i = 0; i <= half; i++) {
      const first = window[i] * samples[i];
      const last = i % half ? window[size - i] * samples[size - i] : 0;
      [this.#even[i], this.#odd[i]] = [first + last, first - last];
    }
    this.#multiply(this.#even, this.#cosines, this.#real);
    this.#multiply(this.#odd, this.#sines, this.#imaginary);
    this.#power.set(this.#real.map((real, bin) => real ** 2 + this.#imaginary[bin] ** 2));
  }

  #multiply(vector, matrix, out) {
    this.#memory.multiplyTransposed(vector.byteOffset, matrix.byteOffset, out.byteOffset, 1, vector.length, out.length, 1);
  }
}
