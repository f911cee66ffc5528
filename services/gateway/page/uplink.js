// A microphone's chunks on their way to the gateway. Pure code: time and the socket are handed in.

import { SAMPLES_PER_MS } from "./playout.js";
import { Recent } from "./recent.js";

const MAX_BUFFERED_BYTES = 1 << 18; // a network slower than speech must not be felt for ever
const MAX_AGE_MS = 500; // of a chunk that is sent: after a moment in which the page was too busy
const CLOCK_MS = 10000; // the sound card's clock drifts, and a busy one loses sound
const OPEN = 1; // WebSocket.OPEN

/** Sends chunks in real time; what the network or this page is too slow for is left out. */
export class Uplink {
  #socket;
  #rateHz;
  #numFrames = 0; // sent or left out
  #numSkipped = 0; // left out, and the gateway does not know yet
  #starts = new Recent(CLOCK_MS); // page's clock at media time 0, by each chunk

  constructor(socket, rateHz) {
    this.#socket = socket;
    this.#rateHz = rateHz;
  }

  /** Send a chunk, int16; both times are the page's clock. */
  send(nowMs, recordedMs, chunk) {
    if (this.#socket.readyState !== OPEN) return;
    this.#numFrames += chunk.length;
    this.#starts.add(recordedMs, recordedMs - (1000 * this.#numFrames) / this.#rateHz);
    const isTooLate = nowMs - recordedMs > MAX_AGE_MS;
    if (isTooLate || this.#socket.bufferedAmount > MAX_BUFFERED_BYTES) {
      this.#numSkipped += chunk.length;
      return;
    }
    if (this.#numSkipped > 0) this.#socket.send(JSON.stringify({ skip: this.#numSkipped }));
    this.#numSkipped = 0;
    this.#socket.send(chunk.buffer);
  }

  /** How long ago media time m was spoken, ms; null before anything was sent. */
  ageMs(nowMs, mediaTime) {
    if (this.#starts.count === 0) return null;
    // The least is the truest: a chunk can be recorded late, never early.
    return nowMs - this.#starts.least - mediaTime / SAMPLES_PER_MS;
  }
}
