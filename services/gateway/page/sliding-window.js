// Statistics of the values of the last seconds. Time is injected.

export class SlidingWindow {
  #windowMs;
  #entries = []; // [when, value]

  /** @param windowMs age at which values are dropped */
  constructor(windowMs) {
    this.#windowMs = windowMs;
  }

  reset() {
    this.#entries = [];
  }

  add(nowMs, value) {
    this.#entries.push([nowMs, value]);
    this.#dropOld(nowMs);
  }

  #dropOld(nowMs) {
    while (this.#entries[0]?.[0] < nowMs - this.#windowMs) this.#entries.shift();
  }

  get count() {
    return this.#entries.length;
  }

  get min() {
    return Math.min(...this.#entries.map((entry) => entry[1]));
  }

  /** Return the median of the values that are not too old at a time; null without values. */
  medianAt(nowMs) {
    this.#dropOld(nowMs);
    return this.percentile(0.5);
  }

  /** Return the maximum of the values that are not too old at a time; null without values. */
  maxAt(nowMs) {
    this.#dropOld(nowMs);
    return this.percentile(1);
  }

  /** Return a percentile, given as a fraction from 0 to 1; null without values. */
  percentile(fraction) {
    if (this.#entries.length === 0) return null;
    const sorted = this.#entries.map((entry) => entry[1]).sort((a, b) => a - b);
    return sorted[Math.min(sorted.length - 1, Math.floor(fraction * sorted.length))];
  }
}
