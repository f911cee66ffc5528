// How often, and with how many pixels, the head is drawn, so that a slow machine keeps up. Pure code:
// time is handed in, nothing is drawn.

import { Recent } from "./recent.js";

const STEP = 0.85; // of the ratio: the pixels, and most of the work, change by its square
const MIN_RATIO = 0.35;
const ENOUGH = 10; // pictures, before their time is believed
const SMOOTHING = 0.2;
const MAX_SHOWN_MS = 200; // a picture that stays for longer waits for a face that moves
const MAX_WAIT_MS = 1000; // until it is seen; longer, the page was hidden
const WAITS_MS = 2000; // over which it is measured when pictures are seen
const TOLERANCE_MS = 8; // half a tick of the display: a picture begins later than its tick
const PERIOD_MS = 50; // 20 pictures a second
const LEAST_REST_MS = 10;
const SLOW_MS = 36; // pictures that take longer get fewer pixels,
const QUICK_MS = 16; // and those that take less get more

export class Pace {
  pictureMs = 0; // that a picture takes, the mean since the ratio changed
  untilSeenMs = 0; // from a face to the middle of the time for which its picture is seen, the median
  #rests;
  #maxRatio;
  #begunMs = -Infinity; // the picture before
  #tookMs = 0;
  #numPictures = 0;
  #seenMs = -Infinity; // when the picture before was
  #shownMs = 0; // for how long one is seen
  #waits = new Recent(WAITS_MS); // until pictures were seen, ms

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

  /** Take note of when a picture is seen, whose face was that of a time. */
  saw(facedMs, seenMs) {
    const sinceMs = seenMs - this.#seenMs;
    if (sinceMs < MAX_SHOWN_MS) this.#shownMs = sinceMs;
    this.#seenMs = seenMs;
    if (seenMs - facedMs > MAX_WAIT_MS) return;
    this.#waits.add(seenMs, seenMs - facedMs + this.#shownMs / 2);
    this.untilSeenMs = this.#waits.percentile(0.5);
  }
}
