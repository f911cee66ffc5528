// Resampling to 16 kHz; services/recognizer/front_end/resample.py has the formula.

/** Streaming: any chunking gives the same samples. */
export class Resampler {
  #up;
  #down;
  #table; // rows of the filter, one for each phase
  #half;
  #known;
  #first; // number of the first known sample
  #numIn = 0;
  #numOut = 0;
  #numPerSecond; // [out, in]

  /** Throws a RangeError if the rate is outside 8000 to 192000 Hz. */
  constructor(rateHz, { constants: { resample: c } }) {
    // Browsers record up to 192 kHz. The server's limit is that of its clients.
    const highest = 4 * c.MAX_RATE_HZ;
    if (!(rateHz >= c.MIN_RATE_HZ && rateHz <= highest)) {
      throw new RangeError(`the sample rate ${rateHz} Hz is out of range; use ${c.MIN_RATE_HZ} to ${highest} Hz`);
    }
    this.#numPerSecond = [c.SAMPLE_RATE_HZ, rateHz];
    const common = gcd(c.SAMPLE_RATE_HZ, rateHz);
    [this.#up, this.#down] = [c.SAMPLE_RATE_HZ / common, rateHz / common];
    const lower = Math.min(1, c.SAMPLE_RATE_HZ / rateHz);
    this.#half = Math.ceil(c.HALF_WIDTH / lower);
    this.#table = filterRows(this.#up, this.#half, lower * c.CUTOFF, c.KAISER_BETA);
    this.#known = new Float32Array(this.#half);
    this.#first = -this.#half;
  }

  /** Take samples, mono in [-1, 1]; return those that are ready at 16 kHz. */
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
    const known = new Float32Array(this.#known.length + samples.length);
    known.set(this.#known);
    known.set(samples, this.#known.length);
    const end = this.#first + known.length;
    const numReady = Math.max(0, Math.ceil(((end - this.#half) * this.#up) / this.#down) - this.#numOut);
    const out = new Float32Array(numReady);
    for (let row = 0; row < numReady; row++) {
      const position = (this.#numOut + row) * this.#down;
      const begin = Math.floor(position / this.#up) - this.#half + 1 - this.#first;
      const filter = this.#table[position % this.#up];
      let total = 0;
      for (let tap = 0; tap < filter.length; tap++) total += filter[tap] * known[begin + tap];
      out[row] = total;
    }
    this.#numOut += numReady;
    const drop = Math.max(0, Math.floor((this.#numOut * this.#down) / this.#up) - this.#half + 1 - this.#first);
    this.#known = known.slice(drop);
    this.#first += drop;
    return out;
  }
}

function filterRows(numPhases, half, cutoff, beta) {
  return Array.from({ length: numPhases }, (_, phase) => {
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
