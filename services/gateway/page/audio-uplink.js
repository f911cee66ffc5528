// Sends a microphone's chunks to the gateway. Time and the socket are injected.

import { SAMPLES_PER_MS } from "./playout.js";
import { SlidingWindow } from "./sliding-window.js";

const MAX_BUFFERED_BYTES = 1 << 18; // limits the delay on a network that is slower than speech
const MAX_BLOCKED_MS = 5000; // a slow network accepts some chunks within this time
const MAX_AGE_MS = 500; // older chunks are dropped; the page was too busy to send them
const CLOCK_MS = 10000; // the sound card's clock drifts, and a busy one loses sound
const MAX_GAP_MS = 500; // after a longer pause of the microphone, older measurements of the clock are wrong
const OPEN = 1; // WebSocket.OPEN

/** Sends chunks in real time. Drops chunks for which the network or the page is too slow. */
export class AudioUplink {
  #socket;
  #rateHz;
  #numSamples = 0; // sent or dropped
  #numSkipped = 0; // dropped and not yet reported to the gateway
  #recordedMs = -Infinity; // when the last chunk was recorded
  #blockedSinceMs = null; // since when the network has accepted nothing; null if it does
  #starts = new SlidingWindow(CLOCK_MS); // page's clock at media time 0, measured at each chunk

  constructor(socket, rateHz) {
    this.#socket = socket;
    this.#rateHz = rateHz;
  }

  /** Send a chunk (int16); both times are on the page's clock. */
  send(nowMs, recordedMs, chunk) {
    if (this.#socket.readyState !== OPEN) return;
    this.#numSamples += chunk.length;
    if (recordedMs - this.#recordedMs > MAX_GAP_MS) this.#starts.reset();
    this.#recordedMs = recordedMs;
    this.#starts.add(recordedMs, recordedMs - (1000 * this.#numSamples) / this.#rateHz);
    const isTooLate = nowMs - recordedMs > MAX_AGE_MS;
    const isBlocked = this.#socket.bufferedAmount > MAX_BUFFERED_BYTES;
    this.#blockedSinceMs = isBlocked ? (this.#blockedSinceMs ?? nowMs) : null;
    if (isTooLate || isBlocked) {
      this.#numSkipped += chunk.length;
      return;
    }
    if (this.#numSkipped > 0) this.#socket.send(JSON.stringify({ skip: this.#numSkipped }));
    this.#numSkipped = 0;
    this.#socket.send(chunk.buffer);
  }

  /** Whether the network is down: it has accepted nothing for 5 s. */
  isDown(nowMs) {
    return this.#blockedSinceMs !== null && nowMs - this.#blockedSinceMs > MAX_BLOCKED_MS;
  }

  /** Return how long ago a media time was spoken, ms; null before the first chunk. */
  ageMs(nowMs, mediaTime) {
    if (this.#starts.count === 0) return null;
    // The minimum is the most accurate: a chunk can be recorded late, never early.
    return nowMs - this.#starts.min - mediaTime / SAMPLES_PER_MS;
  }
}
