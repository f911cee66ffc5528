// Whether the stream is live, and its face or the face at rest is shown. Pure code: time is handed
// in, nothing is drawn.

const STALL_MS = 500; // without frames the face goes to rest
const SILENT_MS = 1000; // without sound, be it silence, nothing is live: idle faces also move
const REST_MS = 80; // time constant of going to rest and coming back

/** Fades between the stream's face and the face at rest. */
export class Presence {
  #framesMs = -Infinity; // when the newest frame came
  #soundMs = -Infinity; // when the newest sound came
  #drawnMs = null;
  #share = 0; // 1: the face is the stream's, 0: at rest

  /** Take the arrival of a frame. */
  frameArrived(nowMs) {
    this.#framesMs = nowMs;
  }

  /** Take the arrival of sound. */
  soundArrived(nowMs) {
    this.#soundMs = nowMs;
  }

  isLive(nowMs) {
    return nowMs - this.#soundMs < SILENT_MS && nowMs - this.#framesMs < SILENT_MS;
  }

  /** Return the stream's share of the picture to be drawn now, 0 to 1. */
  update(nowMs, hasFace) {
    const elapsedMs = nowMs - (this.#drawnMs ?? nowMs);
    this.#drawnMs = nowMs;
    if (elapsedMs > STALL_MS / 2) {
      // While this page was busy nothing could arrive, which is no stall of the stream.
      this.#framesMs = Math.min(nowMs, this.#framesMs + elapsedMs);
      this.#soundMs = Math.min(nowMs, this.#soundMs + elapsedMs);
    }
    const target = hasFace && nowMs - this.#framesMs < STALL_MS ? 1 : 0;
    this.#share += (target - this.#share) * (1 - Math.exp(-elapsedMs / REST_MS));
    if (Math.abs(this.#share - target) < 0.001) this.#share = target;
    return this.#share;
  }
}
