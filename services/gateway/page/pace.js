// How often, and with how many pixels, the head is drawn, so that a slow machine keeps up. Pure code:
// time is handed in, nothing is drawn.

const STEP = 0.85; // of the ratio: the pixels, and most of the work, change by its square
const MIN_RATIO = 0.35;
const ENOUGH = 10; // pictures, before their time is believed
const SMOOTHING = 0.2;
const TOLERANCE_MS = 8; // half a tick of the display: a picture begins later than its tick
const PERIOD_MS = 50; // 20 pictures a second
const LEAST_REST_MS = 10;
const SLOW_MS = 36; // pictures that take longer get fewer pixels,
const QUICK_MS = 16; // and those that take less get more

export class Pace {
  pictureMs = 0; // that a picture takes, the mean since the ratio changed
  #rests;
  #maxRatio;
  #begunMs = -Infinity; // the picture before
  #tookMs = 0;
  #numPictures = 0;

  /**
   * @param ratio the pixels that are drawn for one of the page, to begin with; @param maxRatio at
   *   most; @param rests whether to rest after a picture as long as it took, or until 20 a second are
   *   held: where the processor draws, sound and messages are its work, too
   */
  constructor(ratio, maxRatio, rests) {
    this.#rests = rests;
    this.#maxRatio = maxRatio;
    this.ratio = ratio;
  }

  /** Whether it is time for a picture, once the one before is done. */
  isDue(nowMs) {
    if (!this.#rests) return true;
    const restMs = Math.min(this.#tookMs, Math.max(PERIOD_MS - this.#tookMs, LEAST_REST_MS));
    return nowMs - this.#begunMs >= this.#tookMs + restMs - TOLERANCE_MS;
  }

  /** Take note of a picture: the ratio may change. */
  drew(begunMs, doneMs) {
    this.#begunMs = begunMs;
    this.#tookMs = doneMs - begunMs;
    this.#numPictures++;
    this.pictureMs += Math.max(SMOOTHING, 1 / this.#numPictures) * (this.#tookMs - this.pictureMs);
    if (this.#numPictures < ENOUGH) return;
    const ratio = this.ratio;
    if (this.pictureMs > SLOW_MS) this.ratio = Math.max(MIN_RATIO, STEP * ratio);
    if (this.pictureMs < QUICK_MS) this.ratio = Math.min(this.#maxRatio, ratio / STEP);
    if (this.ratio !== ratio) this.#numPictures = 0;
  }
}
