// Resampling to 16 kHz; services/recognizer/front_end/resample.py has the formula.

import { join } from "./math.js";
import { ProductMemory, alignedBytes } from "./products.js";

const LANES = 4; // taps that a product processes together
const CHUNK_S = 0.1; // longer audio is processed in chunks
const MIN_RATE_HZ = 8_000;
const MAX_RATE_HZ = 192_000; // limit of browsers; the server accepts up to 48 kHz

/** Streaming: any chunking gives the same samples. */
export class Resampler {
  #up;
  #down;
  #memory;
  #numTaps; // a multiple of LANES: zeros follow the filter
  #numPhases;
  #table; // rows of the filter, one for each phase and one for the next sample
  #known; // newest samples; only the first #numKnown are valid
  #out;
  #half;
  #numKnown;
  #maxChunk; // samples
  #first; // number of the first known sample
  #numIn = 0;
  #numOut = 0;
  #numPerSecond; // [out, in]

  /** Throws a RangeError if the rate is outside 8000 to 192000 Hz. */
  constructor(rateHz, { constants: { resample: c } }) {
    if (!(rateHz >= MIN_RATE_HZ && rateHz <= MAX_RATE_HZ)) {
      throw new RangeError(`the sample rate ${rateHz} Hz is out of range; use ${MIN_RATE_HZ} to ${MAX_RATE_HZ} Hz`);
    }
    this.#numPerSecond = [c.SAMPLE_RATE_HZ, rateHz];
    const common = gcd(c.SAMPLE_RATE_HZ, rateHz);
    [this.#up, this.#down] = [c.SAMPLE_RATE_HZ / common, rateHz / common];
    const lower = Math.min(1, c.SAMPLE_RATE_HZ / rateHz);
    this.#half = Math.ceil(c.HALF_WIDTH / lower);
    this.#numPhases = Math.min(this.#up, c.MAX_PHASES);
    const rows = filterRows(this.#numPhases, this.#half, lower * c.CUTOFF, c.KAISER_BETA);
    this.#numTaps = Math.ceil((2 * this.#half) / LANES) * LANES;
    this.#maxChunk = Math.ceil(CHUNK_S * rateHz);
    const numOut = Math.ceil((this.#maxChunk * this.#up) / this.#down) + 1;
    const numKept = 2 * this.#half + Math.ceil(this.#down / this.#up); // between chunks
    const sizes = [rows.length * this.#numTaps, numKept + this.#maxChunk, numOut];
    this.#memory = new ProductMemory(sizes.reduce((sum, size) => sum + alignedBytes(Float32Array, size), 0));
    [this.#table, this.#known, this.#out] = sizes.map((size) => this.#memory.array(Float32Array, size));
    rows.forEach((row, phase) => this.#table.set(row, phase * this.#numTaps));
    this.#numKnown = this.#half; // silence
    this.#first = -this.#half;
  }

  /** Accept samples, mono in [-1, 1]; return the resampled samples that are ready. */
  accept(samples) {
    this.#numIn += samples.length;
    return this.#up === this.#down ? samples : this.#resample(samples);
  }

  /** End the stream; return the remaining samples. */
  finish() {
    const [numOut, numIn] = this.#numPerSecond;
    const numTotal = Math.ceil((this.#numIn * numOut) / numIn);
    if (this.#up === this.#down) return new Float32Array(0);
    const numBefore = this.#numOut;
    return this.#resample(new Float32Array(this.#half)).subarray(0, numTotal - numBefore);
  }

  #resample(samples) {
    const chunks = [];
    for (let begin = 0; begin < samples.length; begin += this.#maxChunk) {
      chunks.push(this.#resampleChunk(samples.subarray(begin, begin + this.#maxChunk)));
    }
    return join(chunks);
  }

  #resampleChunk(samples) {
    const [up, down, known, out] = [this.#up, this.#down, this.#known, this.#out];
    known.set(samples, this.#numKnown);
    this.#numKnown += samples.length;
    const end = this.#first + this.#numKnown;
    const numReady = Math.max(0, Math.ceil(((end - this.#half) * up) / down) - this.#numOut);
    const begin = this.#firstNeeded(this.#numOut);
    const input = known.byteOffset + begin * known.BYTES_PER_ELEMENT;
    const phase = (this.#numOut * down) % up;
    this.#memory.resample(input, this.#table.byteOffset, out.byteOffset, numReady, this.#numTaps, this.#numPhases, up, down, phase);
    this.#numOut += numReady;
    const numOld = Math.max(0, this.#firstNeeded(this.#numOut));
    known.copyWithin(0, numOld, this.#numKnown);
    this.#numKnown -= numOld;
    this.#first += numOld;
    return out.slice(0, numReady);
  }

  /** Return the index, among the known samples, of the first one that an output sample depends on. */
  #firstNeeded(number) {
    return Math.floor((number * this.#down) / this.#up) - this.#half + 1 - this.#first;
  }
}

function filterRows(numPhases, half, cutoff, beta) {
  return Array.from({ length: numPhases + 1 }, (_, phase) => {
    const row = Float64Array.from({ length: 2 * half }, (_value, tap) => {
      const time = phase / numPhases - (tap + 1 - half);
      return sinc(cutoff * time) * bessel(beta * Math.sqrt(Math.max(0, 1 - (time / half) ** 2)));
    });
    const sum = row.reduce((a, b) => a + b);
    return Float32Array.from(row, (weight) => weight / sum);
  });
}

function sinc(x) {
  return x === 0 ? 1 : Math.sin(Math.PI * x) / (Math.PI * x);
}

/** Return the modified Bessel function of order 0, by its power series. */
function bessel(x) {
  let [sum, term] = [1, 1];
  for (let k = 1; term > 1e-12 * sum; k++) {
    term *= (x / 2 / k) ** 2;
    sum += term;
  }
  return sum;
}

function gcd(a, b) {
  return b === 0 ? a : gcd(b, a % b);
}
