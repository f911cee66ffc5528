// What was measured over the last seconds. Pure code: time is handed in.

export class Recent {
  #windowMs;
  #entries = []; // [when, value]

  /** @param windowMs for which a value counts */
  constructor(windowMs) {
    this.#windowMs = windowMs;
  }

  reset() {
    this.#entries = [];
  }

  add(nowMs, value) {
    this.#entries.push([nowMs, value]);
    this.forget(nowMs);
  }

  /** Drop the values that are too old. */
  forget(nowMs) {
    while (this.#entries[0]?.[0] < nowMs - this.#windowMs) this.#entries.shift();
  }

  get count() {
    return this.#entries.length;
  }

  get least() {
    return Math.min(...this.#entries.map((entry) => entry[1]));
  }

  /** Return the greatest value since a time; Infinity if there is none. */
  greatestSince(sinceMs) {
    const recent = this.#entries.filter((entry) => entry[0] > sinceMs);
    return recent.length ? Math.max(...recent.map((entry) => entry[1])) : Infinity;
  }

  /** Return a percentile, the fraction given from 0 to 1; null if there are no values. */
  percentile(fraction) {
    if (this.#entries.length === 0) return null;
    const sorted = this.#entries.map((entry) => entry[1]).sort((a, b) => a - b);
    return sorted[Math.min(sorted.length - 1, Math.floor(fraction * sorted.length))];
  }
}
