// A microphone's chunks on their way to the gateway. Pure code: time and the socket are handed in.

const MAX_BUFFERED_BYTES = 1 << 18; // a network slower than speech must not be felt for ever
const OPEN = 1; // WebSocket.OPEN

/** Sends chunks in real time; what the network does not take is left out of the audio. */
export class Uplink {
  #socket;
  #rateHz;
  #numFrames = 0; // sent or left out
  #numSkipped = 0; // left out, and the gateway does not know yet
  #firstMs = null; // page's clock at media time 0

  constructor(socket, rateHz) {
    this.#socket = socket;
    this.#rateHz = rateHz;
  }

  /** Send a chunk, int16, that was recorded just now. */
  send(nowMs, chunk) {
    if (this.#socket.readyState !== OPEN) return;
    this.#numFrames += chunk.length;
    if (this.#socket.bufferedAmount > MAX_BUFFERED_BYTES) {
      this.#numSkipped += chunk.length;
      return;
    }
    if (this.#numSkipped > 0) this.#socket.send(JSON.stringify({ skip: this.#numSkipped }));
    this.#numSkipped = 0;
    this.#socket.send(chunk.buffer);
    // The least difference seen is the truest: a chunk can be handed over late, never early.
    const firstMs = nowMs - (1000 * this.#numFrames) / this.#rateHz;
    this.#firstMs = Math.min(this.#firstMs ?? Infinity, firstMs);
  }

  /** How long ago media time m was spoken, ms; null before anything was sent. */
  ageMs(nowMs, mediaTime) {
    return this.#firstMs === null ? null : nowMs - this.#firstMs - mediaTime / 16;
  }
}
