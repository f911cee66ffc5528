// Plays the session's sound in sync with its image.

import { SAMPLES_PER_MS } from "./playout.js";
import { SlidingWindow } from "./sliding-window.js";

const RATE_HZ = 16000;
const ALIGN_EVERY_MS = 50;
const MAX_LATENCY_S = 2; // limit for the latency of a loudspeaker
const RECORDER_MS = 30; // delay of the sound that a recorder itself adds (Chromium)
const CLOCK_MS = 1000; // window for the sound card's clock; one reading is off by some ms

export class Sound {
  numPlayed = 0; // samples
  isWanted = false;
  #opening = null; // a promise of #open()
  #context = null;
  #node = null;
  #anchor = null; // media time - context frame, as played
  #alignedMs = 0;
  #starts = new SlidingWindow(CLOCK_MS); // when context frame 0 was audible, ms, one value per reading
  #onChange;
  #tap = null; // node that provides the sound for a recording
  #speaker = null;

  /** @param onChange called when the state may have changed */
  constructor(onChange) {
    this.#onChange = onChange;
  }

  /** "off", "blocked" (until the user clicks) or "on". */
  get state() {
    if (!this.isWanted) return "off";
    return this.isPlaying ? "on" : "blocked";
  }

  /** Whether sound is played, for the loudspeaker or for a recording. */
  get isPlaying() {
    return this.#node !== null && this.#context.state === "running";
  }

  /** Turn sound on. Without a click the browser may leave it blocked. The promise is rejected if sound cannot be opened. */
  async turnOn() {
    this.isWanted = true;
    await this.#run();
  }

  async #run() {
    this.#opening ??= this.#open();
    const opening = this.#opening;
    try {
      await opening;
    } catch (error) {
      if (this.#opening === opening) this.close();
      throw error;
    }
    // Do not wait: without a click, resume() neither succeeds nor fails.
    if (this.isWanted || this.#tap) this.#context?.resume().catch(() => {});
    if (this.#speaker) this.#speaker.gain.value = this.isWanted ? 1 : 0;
    this.#onChange();
  }

  async #open() {
    const context = new AudioContext({ sampleRate: RATE_HZ, latencyHint: "interactive" });
    this.#context = context;
    await context.audioWorklet.addModule(new URL("sound-worklet.js", import.meta.url));
    if (this.#context !== context) return; // closed in the meantime
    this.#node = new AudioWorkletNode(context, "sound-player", { numberOfInputs: 0, outputChannelCount: [1] });
    this.#node.port.onmessage = ({ data }) => {
      this.numPlayed = data.numPlayed;
      this.#anchor = data.anchor;
    };
    this.#speaker = new GainNode(context);
    this.#node.connect(this.#speaker).connect(context.destination);
    context.onstatechange = () => {
      this.#starts.reset();
      this.#onChange();
    };
  }

  /** Release the sound card. turnOn() opens it again. */
  close() {
    if (this.#context !== null) {
      this.#context.onstatechange = null;
      this.#context.close();
    }
    this.#context = this.#opening = this.#node = this.#speaker = this.#anchor = null;
    this.#starts.reset();
    this.#onChange();
  }

  turnOff() {
    this.isWanted = false;
    if (this.#speaker) this.#speaker.gain.value = 0;
    if (this.#tap === null) this.#suspend();
    this.#onChange();
  }

  #suspend() {
    this.#context?.suspend();
    this.#anchor = null;
    this.#starts.reset();
  }

  /** Return the sound as a stream, also while it is off. Call untap() to end it. */
  async tap() {
    await this.#run();
    const stream = new MediaStreamAudioDestinationNode(this.#context);
    // The stream lacks the loudspeaker's delay, but the recorder records the current image.
    const delayTime = Math.max(0, this.outputLatencyMs - RECORDER_MS) / 1000;
    this.#tap = new DelayNode(this.#context, { delayTime, maxDelayTime: MAX_LATENCY_S });
    this.#node.connect(this.#tap).connect(stream);
    await this.#run();
    return stream.stream;
  }

  untap() {
    if (this.#tap === null) return;
    this.#node.disconnect(this.#tap);
    this.#tap = null;
    if (!this.isWanted) this.#suspend();
  }

  /** Queue sound (int16) to be played at a media time. */
  push(mediaTime, samples) {
    if (this.isPlaying) this.#node.port.postMessage({ mediaTime, samples });
  }

  /** Forget the queued sound. Another session's sound has the same media times. */
  clear() {
    this.#node?.port.postMessage({ clear: true });
  }

  get outputLatencyMs() {
    if (!this.isPlaying) return 0;
    return 1000 * (this.#context.outputLatency || this.#context.baseLatency || 0);
  }

  /**
   * Play so that media time m is audible at m + offset on the page's clock. Call it for every image:
   * the sound card's clock drifts, and another device has another delay.
   */
  align(nowMs, offsetMs) {
    if (!this.isPlaying || nowMs - this.#alignedMs < ALIGN_EVERY_MS) return;
    this.#alignedMs = nowMs;
    this.#starts.add(nowMs, this.#startMs());
    const anchor = (this.#starts.percentile(0.5) - offsetMs) * SAMPLES_PER_MS;
    this.#node.port.postMessage({ anchor });
  }

  /** The actual offset of the sound; null while no sound is played. */
  get offsetMs() {
    if (!this.isPlaying || this.#anchor === null || this.#starts.count === 0) return null;
    return this.#starts.percentile(0.5) - this.#anchor / SAMPLES_PER_MS;
  }

  /** Return when context frame 0 was or would have been audible, ms on the page's clock. */
  #startMs() {
    const { contextTime, performanceTime } = this.#context.getOutputTimestamp();
    if (performanceTime) return performanceTime - 1000 * contextTime;
    const { currentTime, outputLatency } = this.#context;
    return performance.now() - 1000 * (currentTime - (outputLatency || 0));
  }
}
