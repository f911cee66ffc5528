// How often and with how many pixels the head is drawn, so that a slow machine keeps up. Images are drawn
// one after another: the next one starts when the last one is done.

import { SlidingWindow } from "./sliding-window.js";

const STEP = 0.85; // factor of the pixel ratio; the number of pixels changes by its square
const MIN_RATIO = 0.35;
const MIN_IMAGES = 10; // number of images after which their mean time is used
const FEW_IMAGES = 3; // the same if all of them are very slow
const SMOOTHING = 0.2;
const MAX_SHOWN_MS = 200; // an image that is shown for longer belongs to a face that does not move
const WINDOW_MS = 2000; // window in which delays are measured
const TOLERANCE_MS = 8; // half a tick of the display; an image starts later than its tick
const PERIOD_MS = 50; // 20 images per second
const TICK_MS = 1000 / 60;
const POLL_MS = 2; // interval of checking whether an image is done
const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;
const MIN_PAUSE_MS = 10;
const SLOW_MS = 36; // images that take longer get fewer pixels
const VERY_SLOW_MS = 150;
const FAST_MS = 16; // images that take less time get more pixels

/** Decides when to draw and with how many pixels. Time is injected. */
export class DrawRate {
  imageMs = 0; // duration of drawing, mean since the ratio changed
  visibleDelayMs = 0; // median time from a face to the middle of the time for which it is visible
  #pauses;
  #maxRatio;
  #startMs = -Infinity; // start of the last image
  #drawMs = 0;
  #numImages = 0;
  #fastestMs = 0; // fastest image since the ratio changed
  #visibleMs = -Infinity; // when the last image became visible
  #minPeriodMs = 0; // minimum time between two images, chosen by the user
  #shownMs = 0; // time for which an image is visible
  #delays = new SlidingWindow(WINDOW_MS); // delays until images were visible, ms

  /**
   * @param options.ratio pixels drawn per pixel of the page, at first
   * @param options.maxRatio maximum ratio
   * @param options.pauses whether to pause after an image for as long as it took, but at most until the next
   *   of 20 per second. Use it when the processor draws: it also has to play sound.
   */
  constructor({ ratio, maxRatio = ratio, pauses }) {
    this.#pauses = pauses;
    this.#maxRatio = maxRatio;
    this.ratio = ratio;
  }

  /** Whether it is time for the next image, if the last one is done. */
  isDue(nowMs) {
    const periodMs = this.#pauses ? periodWithPauseMs(this.#drawMs) : 0;
    return nowMs - this.#startMs >= Math.max(periodMs, this.#minPeriodMs) - TOLERANCE_MS;
  }

  /** Whether the user can halve the image rate, or halve it again. */
  get canHalve() {
    return this.#minPeriodMs < MAX_SHOWN_MS;
  }

  get isReduced() {
    return this.#minPeriodMs > 0;
  }

  /** Halve the image rate. */
  halve() {
    const periodMs = this.#pauses ? periodWithPauseMs(this.imageMs) : this.imageMs;
    this.#minPeriodMs = 2 * Math.max(periodMs, this.#minPeriodMs, TICK_MS);
  }

  /** Undo all halving. */
  restore() {
    this.#minPeriodMs = 0;
  }

  /** Record an image that was drawn. The ratio may change. */
  recordDrawn(startMs, doneMs) {
    this.#startMs = startMs;
    this.#drawMs = doneMs - startMs;
    this.#numImages++;
    this.imageMs += Math.max(SMOOTHING, 1 / this.#numImages) * (this.#drawMs - this.imageMs);
    this.#fastestMs = this.#numImages === 1 ? this.#drawMs : Math.min(this.#fastestMs, this.#drawMs);
    if (this.#numImages < (this.#fastestMs > VERY_SLOW_MS ? FEW_IMAGES : MIN_IMAGES)) return;
    const ratio = this.ratio;
    const step = Math.min(STEP, Math.sqrt(SLOW_MS / this.#fastestMs));
    if (this.imageMs > SLOW_MS) this.ratio = Math.max(MIN_RATIO, step * ratio);
    if (this.imageMs < FAST_MS) this.ratio = Math.min(this.#maxRatio, ratio / STEP);
    if (this.ratio !== ratio) this.#numImages = 0;
  }

  /** Record that an image became visible. faceMs: when its face was computed. */
  recordVisible(faceMs, visibleMs) {
    const sinceMs = visibleMs - this.#visibleMs;
    if (sinceMs < MAX_SHOWN_MS) this.#shownMs = sinceMs;
    this.#visibleMs = visibleMs;
    this.#delays.add(visibleMs, visibleMs - faceMs + this.#shownMs / 2);
    this.visibleDelayMs = this.#delays.percentile(0.5);
  }
}

/** Return the time between two images, ms: the drawing time and the pause after it. */
function periodWithPauseMs(drawMs) {
  return drawMs + Math.min(drawMs, Math.max(PERIOD_MS - drawMs, MIN_PAUSE_MS));
}

/** Return whether the processor draws instead of a graphics card. */
export function drawsInSoftware(gl) {
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  return SOFTWARE.test(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
}

export class ImageQueue {
  numDrawn = 0;
  isDrawing = false;
  #gl;
  #drawRate;
  #hiddenMs = -Infinity; // when the page was hidden last, or shown again

  /** @param gl a WebGL 2 context; @param {DrawRate} drawRate decides how often to draw */
  constructor(gl, drawRate) {
    this.#gl = gl;
    this.#drawRate = drawRate;
    document.addEventListener("visibilitychange", this.#onVisibility);
  }

  /** Stop following whether the page is hidden. */
  close() {
    document.removeEventListener("visibilitychange", this.#onVisibility);
  }

  /**
   * Whether it is time for an image and the last one is done. A slow machine must draw fewer images
   * instead of a queue of late ones that block the page.
   */
  isDue(nowMs) {
    return !this.isDrawing && this.#drawRate.isDue(nowMs);
  }

  /**
   * Draw the face of a time with render(). onVisible gets the time at which it becomes visible, ms,
   * unless the page was hidden in the meantime.
   */
  draw(nowMs, render, onVisible = () => {}) {
    this.isDrawing = true;
    const startMs = performance.now();
    render();
    this.#whenDone(() => {
      this.isDrawing = false;
      this.numDrawn++;
      const doneMs = performance.now();
      this.#drawRate.recordDrawn(startMs, doneMs);
      requestAnimationFrame((tickMs) => {
        const visibleMs = Math.max(tickMs, doneMs); // a busy page gets a tick late
        if (startMs <= this.#hiddenMs) return; // the delay would include the time that it was hidden
        this.#drawRate.recordVisible(nowMs, visibleMs);
        onVisible(visibleMs);
      });
    });
  }

  #onVisibility = () => (this.#hiddenMs = performance.now());

  #whenDone(callback) {
    const gl = this.#gl;
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    const poll = () => {
      if (gl.clientWaitSync(fence, 0, 0) === gl.TIMEOUT_EXPIRED) {
        setTimeout(poll, POLL_MS);
      } else {
        gl.deleteSync(fence);
        callback();
      }
    };
    setTimeout(poll);
  }
}
