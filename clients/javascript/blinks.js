// Blinks of a face without a server, as in shared/face/idle_motion.py.

const MEDIAN_S = 3;
const LOG_SD = 0.5;
const MIN_S = 0.6;
const [FALL_S, CLOSED_S, RISE_S] = [0.08, 0.03, 0.16];
// indices of the FAPs of the lids, and their FAP units when closed
const LIDS = [18, 19, 20, 21];
const CLOSED = [900, 900, 150, 150];

export class Blinks {
  #startS = null; // start of the current or the next blink

  /** Add blinks to the weights or the 68 FAPs of a face, in place; times must rise. */
  apply(values, names, nowS) {
    this.#startS ??= nowS + drawInterval();
    if (nowS > this.#startS + FALL_S + CLOSED_S + RISE_S) this.#startS = nowS + drawInterval();
    const closed = closureAt(nowS - this.#startS);
    if (names.length === 0) LIDS.forEach((fap, i) => (values[fap] += closed * (CLOSED[i] - values[fap])));
    for (const name of ["eyeBlinkLeft", "eyeBlinkRight", "blink"]) {
      const i = names.indexOf(name);
      if (i >= 0) values[i] += closed * (1 - values[i]);
    }
  }
}

/** Return how far the lids are closed, 0 to 1, at a time after the start of a blink. */
function closureAt(sinceS) {
  return sinceS < FALL_S + CLOSED_S ? smoothStep(sinceS / FALL_S) : 1 - smoothStep((sinceS - FALL_S - CLOSED_S) / RISE_S);
}

function smoothStep(value) {
  const x = Math.min(1, Math.max(0, value));
  return x * x * (3 - 2 * x);
}

/** Return a log-normal interval, seconds (Box-Muller). */
function drawInterval() {
  const normal = Math.sqrt(-2 * Math.log(1 - Math.random())) * Math.cos(2 * Math.PI * Math.random());
  return Math.max(MIN_S, MEDIAN_S * Math.exp(LOG_SD * normal));
}
