// The session's sound, played when its picture is due.

import { SAMPLES_PER_MS } from "./playout.js";
import { Recent } from "./recent.js";

const RATE_HZ = 16000;
const ALIGN_EVERY_MS = 50;
const MAX_LATENCY_S = 2; // of a loudspeaker
const RECORDER_MS = 30; // by which a recorder itself has sound later than its picture (Chromium)
const CLOCK_MS = 1000; // over which the sound card's clock is read: one reading is off by some ms

export class Sound {
  numPlayed = 0; // samples
  wanted = false;
  #context = null;
  #node = null;
  #anchor = null; // of what is played: media time - context frame
  #alignedMs = 0;
  #begins = new Recent(CLOCK_MS); // when context frame 0 was heard, ms, by each reading
  #changed;
  #tap = null; // a node that takes the sound for a recording
  #speaker = null;

  /** @param changed called when the state may have changed */
  constructor(changed) {
    this.#changed = changed;
  }

  /** "off", "blocked" (the browser wants a gesture first) or "on". */
  get state() {
    if (!this.wanted) return "off";
    return this.isPlaying ? "on" : "blocked";
  }

  /** Whether sound is played, to be heard or to be recorded. */
  get isPlaying() {
    return this.#node !== null && this.#context.state === "running";
  }

  /** Turn sound on; without a gesture the browser may leave it blocked. */
  async turnOn() {
    this.wanted = true;
    await this.#run();
  }

  async #run() {
    if (this.#context === null) {
      this.#context = new AudioContext({ sampleRate: RATE_HZ, latencyHint: "interactive" });
      await this.#context.audioWorklet.addModule(new URL("sound-worklet.js", import.meta.url));
      const node = new AudioWorkletNode(this.#context, "sound-player", {
        numberOfInputs: 0,
        outputChannelCount: [1],
      });
      node.port.onmessage = ({ data }) => {
        this.numPlayed = data.numPlayed;
        this.#anchor = data.anchor;
      };
      this.#speaker = new GainNode(this.#context);
      node.connect(this.#speaker).connect(this.#context.destination);
      this.#node = node;
      this.#context.onstatechange = () => {
        this.#begins.reset();
        this.#changed();
      };
    }
    // Without a gesture resume() neither succeeds nor fails until there is one: do not wait for it.
    if (this.wanted || this.#tap) this.#context.resume().catch(() => {});
    if (this.#speaker) this.#speaker.gain.value = this.wanted ? 1 : 0;
    this.#changed();
  }

  turnOff() {
    this.wanted = false;
    if (this.#speaker) this.#speaker.gain.value = 0;
    if (this.#tap === null) this.#rest();
    this.#changed();
  }

  #rest() {
    this.#context?.suspend();
    this.#anchor = null;
    this.#begins.reset();
  }

  /** Return the sound as a stream, as it is heard, also while it is off; until untap. */
  async tap() {
    await this.#run();
    const stream = new MediaStreamAudioDestinationNode(this.#context);
    // The stream has no loudspeaker's delay, and a recorder takes the picture that is seen now.
    const delayTime = Math.max(0, this.outputLatencyMs - RECORDER_MS) / 1000;
    this.#tap = new DelayNode(this.#context, { delayTime, maxDelayTime: MAX_LATENCY_S });
    this.#node.connect(this.#tap).connect(stream);
    await this.#run();
    return stream.stream;
  }

  untap() {
    this.#node.disconnect(this.#tap);
    this.#tap = null;
    if (!this.wanted) this.#rest();
  }

  /** Queue sound, int16, to be played when media time gets there. */
  push(mediaTime, samples) {
    if (this.isPlaying) this.#node.port.postMessage({ mediaTime, samples });
  }

  get outputLatencyMs() {
    if (!this.isPlaying) return 0;
    return 1000 * (this.#context.outputLatency || this.#context.baseLatency || 0);
  }

  /**
   * Play such that media time m is heard at m + offset on the page's clock. To be called again and
   * again: the sound card's clock is never quite the page's, and another device has another delay.
   */
  align(nowMs, offsetMs) {
    if (!this.isPlaying || nowMs - this.#alignedMs < ALIGN_EVERY_MS) return;
    this.#alignedMs = nowMs;
    this.#begins.add(nowMs, this.#beginMs());
    const anchor = (this.#begins.percentile(0.5) - offsetMs) * SAMPLES_PER_MS;
    this.#node.port.postMessage({ anchor });
  }

  /** The offset at which sound is really heard; null while none is. */
  get offsetMs() {
    if (!this.isPlaying || this.#anchor === null || this.#begins.count === 0) return null;
    return this.#begins.percentile(0.5) - this.#anchor / SAMPLES_PER_MS;
  }

  /** Read when context frame 0 was heard, or would have been, ms of the page's clock. */
  #beginMs() {
    const { contextTime, performanceTime } = this.#context.getOutputTimestamp();
    if (performanceTime) return performanceTime - 1000 * contextTime;
    const { currentTime, outputLatency } = this.#context;
    return performance.now() - 1000 * (currentTime - (outputLatency || 0));
  }
}
