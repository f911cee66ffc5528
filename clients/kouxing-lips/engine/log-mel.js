// Log-mel bands; services/recognizer/front_end/whisper_mel.py has the formula.

/** Streaming: any chunking gives the same frames. */
export class LogMel {
  #size;
  #hop;
  #window;
  #floor;
  #bands; // weights of the bins from the first edge of each band
  #edges;
  #cosines; // (half / 2 + 1, half): of 2 pi k n / size
  #sines;
  #even; // sums of samples n and size - n, whose cosines are equal
  #odd; // differences, for the sines
  #power; // the spectrum
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
    const half = this.#size / 2;
    const table = (wave) =>
      Float64Array.from({ length: (half / 2 + 1) * half }, (_, i) =>
        wave((2 * Math.PI * ((Math.floor(i / half) * (i % half)) % this.#size)) / this.#size),
      );
    [this.#cosines, this.#sines] = [table(Math.cos), table(Math.sin)];
    [this.#even, this.#odd, this.#power] = [half, half, half + 1].map((size) => new Float64Array(size));
  }

  /** Take samples at 16 kHz, in [-1, 1]; return the new feature frames. */
  accept(samples) {
    const known = new Float32Array(this.#samples.length + samples.length);
    known.set(this.#samples);
    known.set(samples, this.#samples.length);
    const frames = [];
    let begin = 0;
    for (; begin + this.#size <= known.length; begin += this.#hop) {
      frames.push(this.#bandsOf(this.#powers(known.subarray(begin, begin + this.#size))));
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

  /** Return the power spectrum, a discrete Fourier transform that uses three symmetries. */
  #powers(samples) {
    const half = this.#size / 2;
    const [even, odd, powers, cosines, sines] = [this.#even, this.#odd, this.#power, this.#cosines, this.#sines];
    const at = (n) => this.#window[n] * samples[n];
    even[0] = at(0);
    const middle = at(half);
    for (let n = 1; n < half; n++) {
      const one = at(n);
      const other = at(this.#size - n);
      even[n] = one + other;
      odd[n] = one - other;
    }
    for (let k = 0; k <= half / 2; k++) {
      // terms with even and odd n; bin half - k has the same with other signs
      let realEven = k % 2 ? -middle : middle;
      let [realOdd, imaginaryEven, imaginaryOdd] = [0, 0, 0];
      const row = k * half;
      for (let n = 0; n < half; n += 2) {
        realEven += even[n] * cosines[row + n];
        realOdd += even[n + 1] * cosines[row + n + 1];
        imaginaryEven += odd[n] * sines[row + n];
        imaginaryOdd += odd[n + 1] * sines[row + n + 1];
      }
      powers[k] = (realEven + realOdd) ** 2 + (imaginaryEven + imaginaryOdd) ** 2;
      powers[half - k] = (realEven - realOdd) ** 2 + (imaginaryOdd - imaginaryEven) ** 2;
    }
    return powers;
  }
}
