// The sound level and its meter.

import { element } from "./elements.js";

const MAX_QUEUED = 500; // chunks
const DECAY = 0.9; // factor of the level per image
export const SILENT_DB = -60;

/** Measures the level of the audible sound. It decays slowly, so that peaks remain visible. */
export class LevelMeter {
  #queue = []; // { mediaTime, level } of sound that is not audible yet
  #level = 0; // 0 to 1

  reset() {
    this.#queue = [];
  }

  /** Add sound (int16) that becomes audible at a media time. */
  push(mediaTime, samples) {
    this.#queue.push({ mediaTime, level: rms(samples) });
    if (this.#queue.length > MAX_QUEUED) this.#queue.shift();
  }

  /** Raise the level to at least this value, 0 to 1. */
  raise(level) {
    this.#level = Math.max(this.#level, level);
  }

  /** Remove queued sound up to a media time; show its level if isShown. */
  advance(mediaTime, isShown) {
    while (this.#queue[0]?.mediaTime <= mediaTime) {
      const { level } = this.#queue.shift();
      if (isShown) this.raise(level);
    }
  }

  /** Return the level for the next image, dB of full scale. */
  nextDecibels() {
    const db = Math.max(SILENT_DB, 20 * Math.log10(this.#level + 1e-6));
    this.#level *= DECAY;
    return db;
  }
}

/** Return the root mean square of int16 samples, 0 to 1; 0 without samples, as at the end of a session. */
export function rms(samples) {
  let squares = 0;
  for (const sample of samples) squares += sample * sample;
  return Math.sqrt(squares / (samples.length || 1)) / 32768;
}

/** Show a level on the meter, dB of full scale. */
export function showLevel(decibels) {
  const level = (1 - decibels / SILENT_DB).toFixed(3);
  element("meter").firstElementChild.style.transform = `scaleX(${level})`;
  element("meter").setAttribute("aria-valuenow", Math.round(decibels));
}
