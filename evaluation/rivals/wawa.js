// wawa-lipsync: the viseme that it has detected (1 or 0), then its spectrum bands and its volume, at 60 Hz.
// The analyser node follows the Web Audio API, 1.8.6: Blackman window, smoothing of 0.8, -100 to -30 dB.

import { SAMPLE_RATE_HZ, runBlocks } from "./audio-thread.js";

const STEP_S = 1 / 60;
const [SMOOTHING, MIN_DB, MAX_DB] = [0.8, -100, -30];

class Analyser {
  #recent = new Float32Array(0);
  #window;
  #smoothed;

  set fftSize(size) {
    this.frequencyBinCount = size / 2;
    this.#recent = new Float32Array(size);
    this.#smoothed = new Float64Array(size / 2);
    this.#window = Float64Array.from({ length: size }, (_, n) => {
      const angle = (2 * Math.PI * n) / size;
      return 0.42 - 0.5 * Math.cos(angle) + 0.08 * Math.cos(2 * angle);
    });
  }

  add(block) {
    this.#recent.copyWithin(0, block.length);
    this.#recent.set(block, this.#recent.length - block.length);
  }

  getByteFrequencyData(bytes) {
    const size = this.#recent.length;
    const real = Float64Array.from(this.#recent, (sample, n) => sample * this.#window[n]);
    const imaginary = new Float64Array(size);
    transform(real, imaginary);
    for (let k = 0; k < bytes.length; k++) {
      const magnitude = Math.hypot(real[k], imaginary[k]) / size;
      this.#smoothed[k] = SMOOTHING * this.#smoothed[k] + (1 - SMOOTHING) * magnitude;
      const level = (20 * Math.log10(this.#smoothed[k]) - MIN_DB) / (MAX_DB - MIN_DB);
      bytes[k] = Math.max(0, Math.min(255, Math.floor(255 * level)));
    }
  }
}

/** Replace a signal with its spectrum: the FFT of Cooley and Tukey, radix 2, in place. */
function transform(real, imaginary) {
  const size = real.length;
  for (let i = 1, j = 0; i < size; i++) {
    let bit = size >> 1;
    for (; j & bit; bit >>= 1) j ^= bit;
    j ^= bit;
    if (i < j) [real[i], real[j]] = [real[j], real[i]]; // the imaginary part is still 0
  }
  for (let half = 1; half < size; half *= 2) {
    for (let k = 0; k < half; k++) {
      const [cosine, sine] = [Math.cos((Math.PI * k) / half), -Math.sin((Math.PI * k) / half)];
      for (let even = k; even < size; even += 2 * half) {
        const odd = even + half;
        const rotatedReal = cosine * real[odd] - sine * imaginary[odd];
        const rotatedImaginary = cosine * imaginary[odd] + sine * real[odd];
        real[odd] = real[even] - rotatedReal;
        imaginary[odd] = imaginary[even] - rotatedImaginary;
        real[even] += rotatedReal;
        imaginary[even] += rotatedImaginary;
      }
    }
  }
}

globalThis.window = {
  AudioContext: class {
    sampleRate = SAMPLE_RATE_HZ;
    createAnalyser = () => new Analyser();
  },
};
const { Lipsync, VISEMES } = await import("wawa-lipsync");

export async function computeCurves(samples) {
  const node = new Lipsync();
  const visemes = Object.values(VISEMES);
  const rows = runBlocks(
    samples,
    STEP_S,
    (block) => node.analyser.add(block),
    () => {
      node.processAudio();
      const { bands, volume } = node.features;
      return [...visemes.map((name) => Number(name === node.viseme)), ...bands, volume];
    },
  );
  const bands = node.bands.map((_, k) => `band_${k}`);
  return { names: [...visemes, ...bands, "volume"], rows };
}
