// The session's sound, played when its picture is due.

import { SAMPLES_PER_MS } from "./playout.js";

const RATE_HZ = 16000;

export class Sound {
  numPlayed = 0; // samples
  wanted = false;
  #context = null;
  #node = null;
  #anchor = null;
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
      await this.#context.audioWorklet.addModule("sound-worklet.js");
      const node = new AudioWorkletNode(this.#context, "sound-player", {
        numberOfInputs: 0,
        outputChannelCount: [1],
      });
      node.port.onmessage = ({ data }) => (this.numPlayed = data);
      this.#speaker = new GainNode(this.#context);
      node.connect(this.#speaker).connect(this.#context.destination);
      this.#node = node;
      this.#context.onstatechange = this.#changed;
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
  }

  /** Return the sound as a stream, also while it is off; until untap. */
  async tap() {
    await this.#run();
    this.#tap = new MediaStreamAudioDestinationNode(this.#context);
    this.#node.connect(this.#tap);
    await this.#run();
    return this.#tap.stream;
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

  /** Play such that media time m is heard at m + offset on the page's clock. */
  align(nowMs, offsetMs) {
    if (!this.isPlaying) return;
    this.#anchor = Math.round((nowMs - offsetMs) * SAMPLES_PER_MS - this.#heardFrame(nowMs));
    this.#node.port.postMessage({ anchor: this.#anchor });
  }

  /** The offset at which sound is really heard now; null while none is aligned. */
  offsetMs(nowMs) {
    if (!this.isPlaying || this.#anchor === null) return null;
    return nowMs - (this.#heardFrame(nowMs) + this.#anchor) / SAMPLES_PER_MS;
  }

  #heardFrame(nowMs) {
    const stamp = this.#context.getOutputTimestamp();
    const seconds = stamp.performanceTime
      ? stamp.contextTime + (nowMs - stamp.performanceTime) / 1000
      : this.#context.currentTime - (this.#context.outputLatency || 0);
    return seconds * RATE_HZ;
  }
}
