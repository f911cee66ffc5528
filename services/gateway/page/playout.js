// The playout clock: it decides when sound is played and when a face is shown. Both follow media time
// (samples at 16 kHz since the session's first sample). The page's time is injected.

import { SlidingWindow } from "./sliding-window.js";

export const SAMPLES_PER_MS = 16;
const FRAME_MS = 20; // between two FAP frames; interpolation needs both
// The first delay, until arrivals have been measured: after the sound, and after its frame, which arrives later
const FIRST_SOUND_DELAY_MS = 120;
const FIRST_FRAME_DELAY_MS = 60;
// percentile: of the arrivals to wait for. marginMs: added for interpolation. jumpMs: smaller errors
// are corrected by gliding. With sound, playback must not run dry or jump audibly. Without sound,
// a face that is one frame too old is not visible as late.
const WITH_SOUND = { percentile: 0.95, marginMs: FRAME_MS, jumpMs: 30 };
const WITHOUT_SOUND = { percentile: 0.8, marginMs: 0, jumpMs: 5 };
const ADJUST_EVERY_MS = 500;
const MAX_GLIDE = 0.005; // change of speed; a twelfth of a semitone, which is inaudible
const WINDOW_MS = 10000; // window of the percentiles; long enough to ignore a single hiccup
const MIN_FRAMES = 20; // number of frames after which the percentile is used
const RESTART_ERROR_MS = 300; // a stream that is late or early by more than this is restarted …
const RESTART_LATE_FOR_MS = 100; // … after it was late for this long; less than the delay, so that no sound is lost
const RESTART_EARLY_FOR_MS = 300; // … or early for this long
const BURST_MS = 1000; // maximum duration of a burst of data that was delayed or is sent in long chunks
const NUM_BURSTS = 2; // after this number of bursts with nothing between them, the sender is known to send long chunks
const BURST_GAP_MS = 100; // if frames arrive later than this after a burst, the sender does not send long chunks
const RESTART_EARLY_WITH_LONG_CHUNKS_MS = 3000; // longer than a chunk, whose end is early
const START_MS = 300; // time at the start in which the earliest arrivals set the offset
const MAX_BEHIND_MS = 3000; // restart immediately if media time jumps ahead by more than this
export const HOLD_AFTER_MS = 30; // sound waits for late sound after this time; most bursts of delayed sound are shorter
const HOLD_MS = 1000; // … until no sound has been late for this long
const ON_TIME_MS = 100; // sound that is later than the earliest by less than this is on time
const MAX_FRAMES = 1000;

/** Measures how long a condition has held. Time is injected. */
class Streak {
  #sinceMs = null;

  get holds() {
    return this.#sinceMs !== null;
  }

  /** Update the condition; return how long it has held without interruption, ms. */
  update(nowMs, holds) {
    this.#sinceMs = holds ? (this.#sinceMs ?? nowMs) : null;
    return holds ? nowMs - this.#sinceMs : 0;
  }
}

/**
 * Detects that a sender sends long chunks: their frames arrive in bursts, which start late and end on time, with
 * nothing between them. After a pause, the stream stays late. On a busy machine, frames also arrive between the bursts.
 */
class LongChunkDetector {
  isDetected = false;
  #burst = null; // { sinceMs, offsetMs: the offset before it }, until the frames are on time again
  #numBursts = 0; // with nothing between them
  #burstEndMs = 0; // end of the last one

  /** Record the arrival of a frame. offsetMs: of the playout clock; null before the first arrival. */
  frameArrived(nowMs, latenessMs, offsetMs) {
    if (this.#burst !== null) {
      const hasEnded = latenessMs <= this.#burst.offsetMs;
      if (hasEnded) {
        this.#numBursts++;
        this.#burstEndMs = nowMs;
      }
      if (this.#numBursts >= NUM_BURSTS) this.isDetected = true;
      if (hasEnded || nowMs - this.#burst.sinceMs > BURST_MS) this.#burst = null;
    } else if (offsetMs !== null && latenessMs > offsetMs + RESTART_ERROR_MS) {
      this.#burst = { sinceMs: nowMs, offsetMs };
    } else if (nowMs - this.#burstEndMs > BURST_GAP_MS) {
      this.#numBursts = 0;
    }
  }
}

/**
 * The playout clock.
 *
 * Media time m is shown and audible at m + offset on the page's clock. Sound arrives immediately, its FAP
 * frame some 60 to 100 ms later, so the sound must wait. The target of the offset is the 95th
 * percentile of (frame arrival - media time), plus one FAP frame, plus the time until an image is
 * visible. A constant difference between the page's clock and the sender's cancels out. Without
 * sound, as for the user's own voice, the face waits less.
 *
 * The drift of the network and of the clocks moves the target. The offset glides toward the target
 * by at most 5 ms per second, and the sound follows by resampling. Only if the error exceeds 30 ms,
 * half of it is corrected immediately, every half second. So one bad second does not cause a jump. After a
 * stall, the delayed data arrives in a burst. The burst is not measured, so the page is live when it ends.
 * If nothing arrives between bursts, the sender sends long chunks. Then all data is measured, and the offset
 * is that of the start of a chunk, which arrives latest.
 *
 * If the sender pauses, all later sound is late. Late sound therefore raises the offset at first, so that
 * it is played. The offset falls again when sound is on time: then only the network or the machine was slow.
 */
export class Playout {
  isAudible = true;
  outputLatencyMs = 0; // time from the audio thread to the loudspeaker; sound is played earlier by this
  imageDelayMs = 0; // time from computing a face until its image is visible; it is drawn earlier by this
  #offsetMs = null; // without late sound
  #startMs = 0; // when the first offset was set
  #firstFrameMs; // the offset for the earliest frame
  #firstSoundMs; // the offset for the earliest sound
  #targetMs = null; // target of the offset
  #adjustedMs = 0; // when the target was set
  #glidedMs = 0; // when the offset was moved last
  #lateFrames;
  #lateSound;
  #earlyFrames;
  #longChunks;
  #lateSounds = new SlidingWindow(HOLD_MS); // offsets at which late sound is played completely
  #holding = new Streak(); // while there is late sound
  #heldMs = null; // the offset for late sound
  #usualSound = null; // { waitMs: of the latest sound until it is played, onTimeMs: maximum lateness of sound on time }

  constructor() {
    this.reset();
  }

  /** Start again with another session. */
  reset() {
    this.#longChunks = new LongChunkDetector();
    this.#usualSound = null;
    this.#release();
    this.#restart();
  }

  /** Start again after a pause of the stream. */
  #restart() {
    this.#offsetMs = null;
    this.#firstFrameMs = this.#firstSoundMs = Infinity;
    this.#targetMs = null;
    this.#lateFrames = new Streak();
    this.#lateSound = new Streak();
    this.#earlyFrames = new Streak();
    this.#forgetArrivals();
  }

  #forgetArrivals() {
    // Lateness: arrival - media time, ms.
    this.frames = new SlidingWindow(WINDOW_MS);
    this.soundStarts = new SlidingWindow(WINDOW_MS);
    this.soundEnds = new SlidingWindow(WINDOW_MS);
  }

  /** Media time m is shown and audible at m + offset on the page's clock, ms; null before the first arrival. */
  get offsetMs() {
    return this.#offsetMs === null ? null : Math.max(this.#offsetMs, this.#heldMs ?? -Infinity);
  }

  /** How long sound waits for its image, ms; null before any sound. */
  get delayMs() {
    if (this.#offsetMs === null || this.soundEnds.count === 0) return null;
    return this.offsetMs - this.soundEnds.percentile(0.05);
  }

  /** How long after its arrival a frame is visible, ms; null before any frame. */
  get frameWaitMs() {
    if (this.#offsetMs === null || this.frames.count === 0) return null;
    return this.offsetMs - this.frames.percentile(0.5);
  }

  /** Media time that is due at a time, samples; null before the first arrival. */
  mediaAt(nowMs) {
    return this.#offsetMs === null ? null : (nowMs - this.offsetMs) * SAMPLES_PER_MS;
  }

  /** Record the arrival of a frame. Its media time must be greater than the previous frame's. */
  frameArrived(nowMs, mediaTime) {
    const latenessMs = nowMs - mediaTime / SAMPLES_PER_MS;
    const outputMs = Math.max(this.imageDelayMs, this.outputLatencyMs);
    const isEarly = this.#offsetMs !== null && latenessMs + outputMs < this.#offsetMs - RESTART_ERROR_MS;
    const maxEarlyMs = this.#longChunks.isDetected ? RESTART_EARLY_WITH_LONG_CHUNKS_MS : RESTART_EARLY_FOR_MS;
    if (this.#earlyFrames.update(nowMs, isEarly) > maxEarlyMs) this.#restart(); // the others were delayed
    this.#longChunks.frameArrived(nowMs, latenessMs, this.#offsetMs);
    if (this.#isLate(nowMs, latenessMs, this.#lateFrames)) return;
    this.#start(nowMs, latenessMs + FIRST_FRAME_DELAY_MS, Infinity);
    this.frames.add(nowMs, latenessMs);
  }

  /** Record the arrival of a chunk of sound. */
  soundArrived(nowMs, mediaTime, numSamples) {
    const startMs = nowMs - mediaTime / SAMPLES_PER_MS;
    const endMs = startMs - numSamples / SAMPLES_PER_MS;
    this.#holdLateSound(nowMs, startMs, endMs);
    if (this.#isLate(nowMs, endMs, this.#lateSound)) return;
    this.#start(nowMs, Infinity, endMs + FIRST_SOUND_DELAY_MS);
    this.soundStarts.add(nowMs, startMs);
    this.soundEnds.add(nowMs, endMs);
  }

  /** Move the offset toward its target. Call it for every image. */
  adjust(nowMs) {
    this.#glide(nowMs);
    this.#updateHold(nowMs);
    if (this.#offsetMs === null || nowMs - this.#adjustedMs < ADJUST_EVERY_MS) return;
    if (this.frames.count < MIN_FRAMES) return;
    this.#adjustedMs = nowMs;
    const { percentile, marginMs, jumpMs } = this.isAudible || this.#longChunks.isDetected ? WITH_SOUND : WITHOUT_SOUND;
    let latestMs = this.frames.percentile(percentile) + this.imageDelayMs;
    if (this.isAudible && this.soundStarts.count) {
      // The lateness of a long chunk of sound is the lateness of its first sample.
      const soundMs = this.soundStarts.percentile(percentile) + this.outputLatencyMs;
      latestMs = Math.max(latestMs, soundMs);
    }
    this.#targetMs = latestMs + marginMs;
    const errorMs = this.#targetMs - this.#offsetMs;
    if (Math.abs(errorMs) > jumpMs) this.#offsetMs += errorMs / 2;
    if (!this.#holding.holds && this.soundStarts.count) {
      const waitMs = Math.max(0, this.#offsetMs - this.soundStarts.percentile(percentile));
      this.#usualSound = { waitMs, onTimeMs: this.soundEnds.percentile(0.05) + ON_TIME_MS };
    }
  }

  /** Raise the offset for late sound, until sound is on time. */
  #holdLateSound(nowMs, startMs, endMs) {
    if (this.#usualSound === null || this.#offsetMs === null || !this.isAudible) return;
    if (endMs <= this.#usualSound.onTimeMs) this.#release();
    else if (startMs + this.outputLatencyMs > this.#offsetMs) {
      this.#lateSounds.add(nowMs, startMs + this.#usualSound.waitMs);
    }
  }

  #updateHold(nowMs) {
    const heldMs = this.#lateSounds.maxAt(nowMs);
    const forMs = this.#holding.update(nowMs, heldMs !== null);
    // No sound was on time, so the sender paused: keep the offset.
    if (heldMs === null && this.#heldMs !== null) this.#offsetMs = Math.max(this.#offsetMs, this.#heldMs);
    this.#heldMs = forMs < HOLD_AFTER_MS ? null : heldMs;
  }

  #release() {
    this.#lateSounds.reset();
    this.#holding = new Streak();
    this.#heldMs = null;
  }

  #glide(nowMs) {
    const maxMs = MAX_GLIDE * (nowMs - this.#glidedMs);
    this.#glidedMs = nowMs;
    if (this.#targetMs === null) return;
    const errorMs = this.#targetMs - this.#offsetMs;
    this.#offsetMs += Math.max(-maxMs, Math.min(maxMs, errorMs));
  }

  /**
   * Set the first offset. Queued data arrives in a burst, and its end gives the best estimate. A long
   * chunk must be played from its start. Sound and frames have their own estimates, because a frame
   * can arrive long after its sound.
   */
  #start(nowMs, frameOffsetMs, soundOffsetMs) {
    if (this.#offsetMs === null) this.#startMs = nowMs;
    else if (nowMs - this.#startMs > START_MS) return;
    const choose = (first, next) => (this.#longChunks.isDetected && first < Infinity ? first : Math.min(first, next));
    const frameMs = choose(this.#firstFrameMs, frameOffsetMs);
    const soundMs = choose(this.#firstSoundMs, soundOffsetMs);
    if (frameMs === this.#firstFrameMs && soundMs === this.#firstSoundMs) return;
    this.#firstFrameMs = frameMs;
    this.#firstSoundMs = soundMs;
    const offsetMs = Math.max(...[this.#firstFrameMs, this.#firstSoundMs].filter(Number.isFinite));
    if (offsetMs === this.#offsetMs) return;
    this.#offsetMs = offsetMs;
    this.#forgetArrivals();
  }

  /**
   * Return whether data is too late to measure the usual delay. Data that was delayed by the network
   * or by a busy page arrives in one burst whose end is on time. If later data is also late, the
   * sender paused. Start again after a pause, or if media time jumped ahead.
   */
  #isLate(nowMs, latenessMs, streak) {
    if (this.#offsetMs === null) return false;
    const lateMs = latenessMs - this.#offsetMs;
    const lateForMs = streak.update(nowMs, lateMs > (streak.holds ? 0 : RESTART_ERROR_MS));
    const isPaused = lateForMs > RESTART_LATE_FOR_MS || (streak.holds && this.#longChunks.isDetected);
    if (isPaused || lateMs < -MAX_BEHIND_MS) this.#restart();
    return this.#offsetMs !== null && streak.holds;
  }
}

/** FAP frames in order of media time, with interpolation. */
export class FapTrack {
  #frames = []; // [media time, Float32Array]

  reset() {
    this.#frames.length = 0;
  }

  /** Add a frame; return whether it advances media time. */
  push(mediaTime, values) {
    const last = this.#frames.at(-1);
    if (last !== undefined && mediaTime <= last[0]) {
      // Media time does not advance while the sound pauses, but the face still moves to rest.
      if (mediaTime === last[0]) last[1] = values;
      return false;
    }
    this.#frames.push([mediaTime, values]);
    if (this.#frames.length > MAX_FRAMES) this.#frames.shift();
    return true;
  }

  /** Write the face at a media time to `out`; return its media time, or null without frames. */
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
