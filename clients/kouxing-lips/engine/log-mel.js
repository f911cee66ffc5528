// Log-mel bands; services/recognizer/front_end/whisper_mel.py has the formula.

/** Streaming: any chunking gives the same frames. */
export class LogMel {
  #size;
  #hop;
  #window;
  #floor;
  #bands; // weights of the bins from the first edge of each band
  #edges;
  #root; // square root of the size
  #columnWaves; // { cosines, sines } of 2 pi k n / root, (root, root)
  #twiddles; // { cosines, sines } of 2 pi k n / size, (root, root)
  #windowed; // samples, (root, root)
  #real; // transforms of the columns, (root / 2 + 1, root)
  #imaginary;
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
    const root = Math.sqrt(this.#size);
    const wave = (compute, size) =>
      Float64Array.from({ length: root * root }, (_, i) => compute((2 * Math.PI * Math.floor(i / root) * (i % root)) / size));
    const waves = (size) => ({ cosines: wave(Math.cos, size), sines: wave(Math.sin, size) });
    this.#root = root;
    [this.#columnWaves, this.#twiddles] = [waves(root), waves(this.#size)];
    [this.#real, this.#imaginary] = [0, 0].map(() => new Float64Array((root / 2 + 1) * root));
    this.#windowed = new Float64Array(this.#size);
    this.#power = new Float64Array(this.#size / 2 + 1);
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

  /**
   * Return the power spectrum. The samples are the rows of a square, whose columns and then rows are
   * transformed (Cooley & Tukey 1965). The columns are real, so half of their transform is enough.
   */
  #powerSpectrum(samples) {
    const [size, root, windowed, window] = [this.#size, this.#root, this.#windowed, this.#window];
    const [real, imaginary, power] = [this.#real, this.#imaginary, this.#power];
    const { cosines, sines } = this.#columnWaves;
    const { cosines: rotationCosines, sines: rotationSines } = this.#twiddles;
    const half = root / 2;
    for (let i = 0; i < size; i++) windowed[i] = window[i] * samples[i];
    for (let column = 0; column < root; column++) {
      for (let k = 0; k <= half; k++) {
        let re = 0;
        let im = 0;
        for (let n = 0, at = column, wave = k * root; n < root; n++, at += root, wave++) {
          re += windowed[at] * cosines[wave];
          im -= windowed[at] * sines[wave];
        }
        const index = k * root + column;
        real[index] = re * rotationCosines[index] + im * rotationSines[index];
        imaginary[index] = im * rotationCosines[index] - re * rotationSines[index];
      }
    }
    for (let k = 0; k <= half; k++) {
      for (let row = 0; row < half; row++) {
        // even and odd terms; in the bin half of the rows later, the odd terms have the opposite sign
        let evenReal = 0;
        let evenImaginary = 0;
        let oddReal = 0;
        let oddImaginary = 0;
        for (let n = 0, at = k * root, wave = row * root; n < half; n++, at += 2, wave += 2) {
          evenReal += real[at] * cosines[wave] + imaginary[at] * sines[wave];
          evenImaginary += imaginary[at] * cosines[wave] - real[at] * sines[wave];
          oddReal += real[at + 1] * cosines[wave + 1] + imaginary[at + 1] * sines[wave + 1];
          oddImaginary += imaginary[at + 1] * cosines[wave + 1] - real[at + 1] * sines[wave + 1];
        }
        // the upper half of the spectrum mirrors the lower half
        const bin = k + root * row;
        power[bin] = (evenReal + oddReal) ** 2 + (evenImaginary + oddImaginary) ** 2;
        power[size / 2 - bin] = (evenReal - oddReal) ** 2 + (evenImaginary - oddImaginary) ** 2;
      }
    }
    return power;
  }
}
