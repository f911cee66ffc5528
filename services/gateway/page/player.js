// Plays the session that is shown: it keeps sound and image in sync and computes the face that is due.

import { Lateness } from "./lateness.js";
import { FapTrack, HOLD_AFTER_MS, Playout } from "./playout.js";
import { SlidingWindow } from "./sliding-window.js";
import { StreamActivity } from "./stream-activity.js";

const NUM_FAPS = 68;
const DELAY_WINDOW_MS = 2000;

export class Player {
  playout = new Playout();
  faps; // the face that is shown
  restFaps; // shown while no session moves the face
  numFrames = 0; // received
  #track = new FapTrack();
  activity = new StreamActivity();
  lateness = new Lateness();
  #streamFaps;
  #imageDelays = new SlidingWindow(DELAY_WINDOW_MS); // ms from the user's voice to the image
  #frameDelays = new SlidingWindow(DELAY_WINDOW_MS); // ms from the user's voice to its frame
  #sound;
  #voiceAgeMs;

  /**
   * @param {Sound} sound plays the session's sound
   * @param voiceAgeMs (nowMs, mediaTime): how long ago this browser's user spoke, ms; null if the
   *   session is not the user's
   * @param numValues of a face; other than 68 for blendshapes
   */
  constructor(sound, voiceAgeMs = () => null, numValues = NUM_FAPS) {
    this.#sound = sound;
    this.#voiceAgeMs = voiceAgeMs;
    this.faps = new Float32Array(numValues);
    this.restFaps = new Float32Array(numValues);
    this.#streamFaps = new Float32Array(numValues);
  }

  /** Start again with another session, or with another epoch. */
  reset(isOtherSession) {
    if (isOtherSession) this.#sound.clear();
    this.playout.reset();
    this.#track.reset();
    this.lateness = new Lateness();
    this.#imageDelays.reset();
    this.#frameDelays.reset();
  }

  addFrame(mediaTime, faps) {
    const nowMs = performance.now();
    if (this.#track.push(mediaTime, faps)) this.playout.frameArrived(nowMs, mediaTime);
    this.activity.frameArrived(nowMs);
    this.lateness.frameArrived(nowMs, mediaTime);
    this.#addVoiceAge(this.#frameDelays, nowMs, mediaTime);
    this.numFrames++;
  }

  addSound(mediaTime, samples) {
    const nowMs = performance.now();
    this.playout.soundArrived(nowMs, mediaTime, samples.length);
    this.#sync(nowMs); // nothing else calls it while the page is hidden
    setTimeout(() => this.#sync(performance.now()), HOLD_AFTER_MS);
    this.activity.soundArrived(nowMs);
    this.#sound.push(mediaTime, samples);
  }

  /**
   * Compute the face of the next image.
   *
   * @param imageDelayMs how long after now the image will be visible
   * @returns { mediaTime: when the image is visible, frameTime: media time of the face, null at
   *   rest, hasChanged: whether the face differs from the last one }
   */
  update(nowMs, imageDelayMs) {
    this.playout.imageDelayMs = imageDelayMs;
    this.#sync(nowMs);
    const mediaTime = this.playout.mediaAt(nowMs + imageDelayMs);
    const frameTime = mediaTime === null ? null : this.#track.sample(mediaTime, this.#streamFaps);
    const weight = this.activity.update(nowMs, frameTime !== null);
    return { mediaTime, frameTime, hasChanged: this.#mix(weight) };
  }

  /** Record that the image of a frame became visible. faceMs: when its face was computed. */
  imageVisible(faceMs, visibleMs, frameTime) {
    this.lateness.imageVisible(faceMs, visibleMs);
    if (frameTime !== null) this.#addVoiceAge(this.#imageDelays, visibleMs, frameTime);
  }

  /** Median delay from the user's voice to the image, ms; null while unknown. */
  get voiceToImageMs() {
    return this.#imageDelays.medianAt(performance.now());
  }

  /** Median delay from the user's voice to the arrival of its frame, ms; null while unknown. */
  get voiceToFrameMs() {
    return this.#frameDelays.medianAt(performance.now());
  }

  /** How much later than its image sound is audible, ms; null without sound. */
  get soundMinusImageMs() {
    const offsetMs = this.#sound.offsetMs;
    return offsetMs === null ? null : offsetMs - this.playout.offsetMs;
  }

  #sync(nowMs) {
    this.playout.isAudible = this.#sound.isPlaying;
    this.playout.outputLatencyMs = this.#sound.outputLatencyMs;
    this.playout.adjust(nowMs);
    if (this.playout.offsetMs !== null) this.#sound.align(nowMs, this.playout.offsetMs);
  }

  #addVoiceAge(delays, nowMs, mediaTime) {
    const ageMs = this.activity.isLive(nowMs) ? this.#voiceAgeMs(nowMs, mediaTime) : null;
    if (ageMs !== null) delays.add(nowMs, ageMs);
  }

  /** Mix the stream's face with the face at rest; return whether the result has changed. */
  #mix(weight) {
    const [faps, stream, rest] = [this.faps, this.#streamFaps, this.restFaps];
    let hasChanged = false;
    for (let i = 0; i < faps.length; i++) {
      const value = Math.fround(rest[i] + weight * (stream[i] - rest[i]));
      hasChanged ||= value !== faps[i];
      faps[i] = value;
    }
    return hasChanged;
  }
}
