// How loud it is, for the meter. Pure code: nothing is drawn.

const MAX_QUEUED = 500; // chunks
const DECAY = 0.9; // share of the level that is left at the next picture
export const SILENT_DB = -60;

/** The level of the sound that is heard now; it falls slowly, so that peaks are seen. */
export class LevelMeter {
  #queue = []; // { mediaTime, level } of the sound that is still to be heard
  #level = 0; // 0 to 1

  reset() {
    this.#queue = [];
  }

  /** Take sound, int16, that will be heard when media time gets there. */
  push(mediaTime, samples) {
    this.#queue.push({ mediaTime, level: rms(samples) });
    if (this.#queue.length > MAX_QUEUED) this.#queue.shift();
  }

  /** Show at least this level (0 to 1) now. */
  raise(level) {
    this.#level = Math.max(this.#level, level);
  }

  /** Show the sound up to a media time, or leave it out if it is not to be shown. */
  advance(mediaTime, isShown) {
    while (this.#queue[0]?.mediaTime <= mediaTime) {
      const { level } = this.#queue.shift();
      if (isShown) this.raise(level);
    }
  }

  /** Return the level in dB of full scale for one picture. */
  decibels() {
    const db = Math.max(SILENT_DB, 20 * Math.log10(this.#level + 1e-6));
    this.#level *= DECAY;
    return db;
  }
}

/** Return the root mean square of int16 samples, 0 to 1. */
export function rms(samples) {
  let squares = 0;
  for (const sample of samples) squares += sample * sample;
  return Math.sqrt(squares / samples.length) / 32768;
}
