// Measures how far the face of a live stream is behind, and decides whether the page shows it. Time is injected.

import { SlidingWindow } from "./sliding-window.js";
import { SAMPLES_PER_MS } from "./playout.js";

const WINDOW_MS = 10000; // as in services/synthesizer/lateness.py
const LATE_MS = 300; // a face that is later than this is late
const MIN_SKIP_MS = 100;
const MAX_SKIP_MS = 10000; // a longer gap is a pause of the client
const SHOWN_AFTER_MS = 1000; // time with late frames until the notice appears
const OVER_AFTER_MS = 2000; // time without late frames until it disappears
const RECENT_MS = 1000; // window of the displayed lateness
const IMAGES_MS = 3000; // window of the delays of images

/**
 * The lateness of the face: the lateness of the newest frame, plus the delay until its image is visible. A live
 * client sends audio in real time. The arrival of a frame minus its media time is therefore constant for
 * frames that are on time, and greater for late frames. Frames are compared with the earliest one of the
 * last 10 s, because clocks drift and a client may lose audio.
 */
export class Lateness {
  isBehind = false; // true after frames have been late for some time
  #newest = -1; // media time, samples
  #differences = new SlidingWindow(WINDOW_MS); // arrival - media time, ms
  #recent = new SlidingWindow(RECENT_MS); // lateness, ms
  #imageDelays = new SlidingWindow(IMAGES_MS); // delays until images are visible, ms
  #confirmedMs = null; // when isBehind was last correct

  /**
   * Record the arrival of a frame. Media time does not advance while the client sends no audio. Media time
   * jumps if a busy machine skips frames to stay live.
   */
  frameArrived(nowMs, mediaTime) {
    const stepMs = (mediaTime - this.#newest) / SAMPLES_PER_MS;
    if (stepMs === 0) this.#differences.reset();
    if (stepMs <= 0) return;
    if (this.#newest >= 0 && stepMs > MIN_SKIP_MS && stepMs < MAX_SKIP_MS) {
      this.isBehind = true;
      this.#confirmedMs = nowMs;
    }
    this.#newest = mediaTime;
    this.#differences.add(nowMs, nowMs - mediaTime / SAMPLES_PER_MS);
  }

  /** Record that an image became visible. faceMs: when its face was computed. */
  imageVisible(faceMs, visibleMs) {
    this.#imageDelays.add(visibleMs, visibleMs - faceMs);
  }

  /** Update isBehind; call this regularly. isLive: whether frames and sound arrive. */
  update(nowMs, isLive) {
    const imageDelayMs = this.#imageDelays.medianAt(nowMs) ?? 0; // a face that does not move has no images
    const differenceMs = nowMs - this.#newest / SAMPLES_PER_MS;
    const lateMs = isLive ? imageDelayMs + Math.max(0, differenceMs - this.#differences.min) : 0;
    this.#recent.add(nowMs, lateMs);
    const isLate = lateMs > LATE_MS;
    if (isLate === this.isBehind) this.#confirmedMs = nowMs;
    this.#confirmedMs ??= nowMs;
    const waitMs = isLate ? SHOWN_AFTER_MS : OVER_AFTER_MS;
    if (nowMs - this.#confirmedMs >= waitMs) this.isBehind = isLate;
  }

  /** The maximum lateness of the last second, ms. */
  get recentMs() {
    return this.#recent.percentile(1);
  }
}
