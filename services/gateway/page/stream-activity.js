// Whether the stream is live, and the fade between its face and the face at rest. Time is injected.

const STALL_MS = 500; // time without frames until the face fades to rest
const SILENT_MS = 1000; // time without sound messages until the stream is not live; idle faces also move
const FADE_MS = 80; // time constant of the fade

export class StreamActivity {
  #lastFrameMs = -Infinity;
  #lastSoundMs = -Infinity;
  #updatedMs = null;
  #weight = 0; // fraction of the stream's face, 0 to 1; the rest is the face at rest

  frameArrived(nowMs) {
    this.#lastFrameMs = nowMs;
  }

  soundArrived(nowMs) {
    this.#lastSoundMs = nowMs;
  }

  isLive(nowMs) {
    return nowMs - this.#lastSoundMs < SILENT_MS && nowMs - this.#lastFrameMs < SILENT_MS;
  }

  /** Return the stream's fraction of the face to be drawn now, 0 to 1. */
  update(nowMs, hasFace) {
    const elapsedMs = nowMs - (this.#updatedMs ?? nowMs);
    this.#updatedMs = nowMs;
    if (elapsedMs > STALL_MS / 2) {
      // The page was busy and received nothing. This is not a stall of the stream.
      this.#lastFrameMs = Math.min(nowMs, this.#lastFrameMs + elapsedMs);
      this.#lastSoundMs = Math.min(nowMs, this.#lastSoundMs + elapsedMs);
    }
    const target = hasFace && nowMs - this.#lastFrameMs < STALL_MS ? 1 : 0;
    this.#weight += (target - this.#weight) * (1 - Math.exp(-elapsedMs / FADE_MS));
    if (Math.abs(this.#weight - target) < 0.001) this.#weight = target;
    return this.#weight;
  }
}
