// Whether the face is the stream's or at rest. Pure code: time is handed in, nothing is drawn.

const STALL_MS = 500; // without frames the face goes to rest
const REST_MS = 80; // time constant of going there and coming back

/** Fades between the stream's face and the face at rest. */
export class Presence {
  #arrivedMs = -Infinity; // when the newest frame came
  #drawnMs = null;
  #share = 0; // 1: the face is the stream's, 0: at rest

  /** Take the arrival of a frame. */
  frameArrived(nowMs) {
    this.#arrivedMs = nowMs;
  }

  isLive(nowMs) {
    return nowMs - this.#arrivedMs < STALL_MS;
  }

  /** Return the stream's share of the picture to be drawn now, 0 to 1. */
  update(nowMs, hasFace) {
    const elapsedMs = nowMs - (this.#drawnMs ?? nowMs);
    this.#drawnMs = nowMs;
    // While this page was busy nothing could arrive, which is no stall of the stream.
    if (elapsedMs > STALL_MS / 2) this.#arrivedMs = Math.min(nowMs, this.#arrivedMs + elapsedMs);
    const target = hasFace && this.isLive(nowMs) ? 1 : 0;
    this.#share += (target - this.#share) * (1 - Math.exp(-elapsedMs / REST_MS));
    if (Math.abs(this.#share - target) < 0.001) this.#share = target;
    return this.#share;
  }
}
