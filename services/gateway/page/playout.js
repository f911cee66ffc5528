// When to show and sound what: the only clock between sound and picture is media time (samples at
// 16 kHz since the session's first sample). Pure code: time is handed in, nothing is drawn.

import { Recent } from "./recent.js";

export const SAMPLES_PER_MS = 16;
const FRAME_MS = 20; // between two FAP frames: a face between them needs both
const FIRST_DELAY_MS = 120; // before anything has been measured
// The arrival that is waited for, of a hundred, the frames that a face between them needs, and the
// error that is left to gliding: where sound is heard, which must never run dry or be heard to
// leap; and where it is not, and a face that is a frame too old is seen by nobody.
const HEARD = { percentile: 0.95, marginMs: FRAME_MS, leapMs: 30 };
const MUTE = { percentile: 0.8, marginMs: 0, leapMs: 5 };
const ADJUST_EVERY_MS = 500;
const GLIDE = 0.005; // of the pace: a twelfth of a semitone, which nobody hears
const WINDOW_MS = 10000; // that the percentiles are taken over: a single hiccup must not count
const ENOUGH = 20; // frames before the percentile is believed
const JUMP_MS = 300; // a stream that is later, or earlier, by this: start again
const SURE_MS = 100; // for which it must be late; less than the delay, so that no sound is lost
const MAX_BEHIND_MS = 3000; // media time that leaps ahead by this: start again at once
const MAX_FRAMES = 1000;

/**
 * The playout clock.
 *
 * Media time m is shown, and heard, at m + offset on the page's clock. Sound reaches us as soon as
 * it was heard, its FAP frame some 60 to 100 ms later, so sound has to wait: the target of the offset
 * is the 95th percentile of (frame arrival - media time), plus one FAP frame, plus the time until a
 * picture is seen. The difference between the page's clock and the sender's is in every lateness
 * alike and drops out. Without sound, as for one's own voice, the face waits less.
 *
 * The network's and the clocks' drift moves the target. The offset glides after it, by 5 ms a second
 * at most, which the sound follows by resampling. Only if it is off by more than 30 ms, half of the
 * error is corrected at once, every half second, so that one bad second is not answered by a leap.
 */
export class Playout {
  isHeard = true;
  outputLatencyMs = 0; // from the audio thread to the loudspeaker; sound must leave so much earlier
  pictureMs = 0; // from a face until its picture is seen; it must be drawn so much earlier
  #offsetMs = null;
  #begunMs = 0; // when the first offset was set
  #targetMs = null; // of the offset
  #adjustedMs = 0; // when the target was set
  #glidedMs = 0; // when the offset was moved
  #lateSinceMs = null; // when what arrives began to be too late

  constructor() {
    this.reset();
  }

  /** Forget everything: another session, or the stream paused. */
  reset() {
    this.#offsetMs = null;
    this.#targetMs = null;
    this.#lateSinceMs = null;
    // Each one's lateness: arrival - media time, ms.
    this.frames = new Recent(WINDOW_MS);
    this.soundStarts = new Recent(WINDOW_MS);
    this.soundEnds = new Recent(WINDOW_MS);
  }

  get offsetMs() {
    return this.#offsetMs;
  }

  /** How long sound waits for its picture, ms; null before any sound. */
  get delayMs() {
    if (this.#offsetMs === null || this.soundEnds.count === 0) return null;
    return this.#offsetMs - this.soundEnds.percentile(0.05);
  }

  /** How long after its arrival the picture of a frame is seen, ms; null before any. */
  get frameWaitMs() {
    if (this.#offsetMs === null || this.frames.count === 0) return null;
    return this.#offsetMs - this.frames.percentile(0.5);
  }

  /** Media time that is due at a time, samples; null before anything arrived. */
  mediaAt(nowMs) {
    return this.#offsetMs === null ? null : (nowMs - this.#offsetMs) * SAMPLES_PER_MS;
  }

  /** Take the arrival of a frame whose media time advances. */
  frameArrived(nowMs, mediaTime) {
    const latenessMs = nowMs - mediaTime / SAMPLES_PER_MS;
    this.#resyncIfFar(nowMs, latenessMs);
    this.frames.add(nowMs, latenessMs);
    this.#begin(nowMs, latenessMs + FIRST_DELAY_MS / 2);
  }

  /** Take the arrival of a chunk of sound. */
  soundArrived(nowMs, mediaTime, numSamples) {
    const startMs = nowMs - mediaTime / SAMPLES_PER_MS;
    const endMs = startMs - numSamples / SAMPLES_PER_MS;
    this.#resyncIfFar(nowMs, endMs);
    this.soundStarts.add(nowMs, startMs);
    this.soundEnds.add(nowMs, endMs);
    this.#begin(nowMs, endMs + FIRST_DELAY_MS);
  }

  /** Move the offset towards its target; to be called again and again. */
  adjust(nowMs) {
    this.#glide(nowMs);
    if (this.#offsetMs === null || nowMs - this.#adjustedMs < ADJUST_EVERY_MS) return;
    if (this.frames.count < ENOUGH) return;
    this.#adjustedMs = nowMs;
    if (this.frames.greatestSince(nowMs - ADJUST_EVERY_MS) < this.#offsetMs - JUMP_MS) {
      this.reset(); // what was held up on the way has come, and the stream is live again
      return;
    }
    const { percentile, marginMs, leapMs } = this.isHeard ? HEARD : MUTE;
    let latestMs = this.frames.percentile(percentile) + this.pictureMs;
    if (this.isHeard && this.soundStarts.count) {
      // A long chunk of sound is as late as its first sample.
      const soundMs = this.soundStarts.percentile(percentile) + this.outputLatencyMs;
      latestMs = Math.max(latestMs, soundMs);
    }
    this.#targetMs = latestMs + marginMs;
    const errorMs = this.#targetMs - this.#offsetMs;
    if (Math.abs(errorMs) > leapMs) this.#offsetMs += errorMs / 2;
  }

  #glide(nowMs) {
    const mostMs = GLIDE * (nowMs - this.#glidedMs);
    this.#glidedMs = nowMs;
    if (this.#targetMs === null) return;
    const errorMs = this.#targetMs - this.#offsetMs;
    this.#offsetMs += Math.max(-mostMs, Math.min(mostMs, errorMs));
  }

  /** Set the first offset: what had piled up before comes at once, and its end is the truest. */
  #begin(nowMs, offsetMs) {
    if (this.#offsetMs === null) this.#begunMs = nowMs;
    if (nowMs - this.#begunMs < SURE_MS) {
      this.#offsetMs = Math.min(this.#offsetMs ?? Infinity, offsetMs);
    }
  }

  /**
   * Start again if the sender paused, or media time leapt ahead. What was held up on the way, or by
   * this page being busy, comes in one burst whose end is on time again: that is no pause.
   */
  #resyncIfFar(nowMs, latenessMs) {
    if (this.#offsetMs === null) return;
    const lateMs = latenessMs - this.#offsetMs;
    if (lateMs <= JUMP_MS) this.#lateSinceMs = null;
    else this.#lateSinceMs ??= nowMs;
    const hasPaused = this.#lateSinceMs !== null && nowMs - this.#lateSinceMs > SURE_MS;
    if (hasPaused || lateMs < -MAX_BEHIND_MS) this.reset();
  }
}

/** FAP frames in order of media time, and the face between two of them. */
export class FapTrack {
  #frames = []; // [media time, Float32Array]

  reset() {
    this.#frames.length = 0;
  }

  /** Add a frame; return whether it advances media time. */
  push(mediaTime, values) {
    const last = this.#frames.at(-1);
    if (last !== undefined && mediaTime <= last[0]) {
      // While the sound pauses media time stands still, and the face still goes to rest.
      if (mediaTime === last[0]) last[1] = values;
      return false;
    }
    this.#frames.push([mediaTime, values]);
    if (this.#frames.length > MAX_FRAMES) this.#frames.shift();
    return true;
  }

  /** Write the face at a media time; return the media time it belongs to, null without any. */
  sample(mediaTime, out) {
    const frames = this.#frames;
    while (frames.length > 2 && frames[1][0] <= mediaTime) frames.shift();
    if (frames.length === 0) return null;
    const [t0, a] = frames[0];
    const [t1, b] = frames[Math.min(1, frames.length - 1)];
    const mix = t1 > t0 ? Math.min(1, Math.max(0, (mediaTime - t0) / (t1 - t0))) : 1;
    for (let i = 0; i < out.length; i++) out[i] = a[i] + mix * (b[i] - a[i]);
    return Math.min(Math.max(mediaTime, t0), t1);
  }
}
