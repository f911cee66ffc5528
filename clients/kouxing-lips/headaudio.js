// The interface of HeadAudio (npm @met4citizen/headaudio) with the visemes of this package.

import { LipSync } from "./index.js";

/** An audio node that reports Oculus visemes. Its face is for the sound of 0.1 s ago. */
export class HeadAudio extends GainNode {
  /** Called with (name, weight) when the weight of a viseme changes. */
  onvalue = null;
  /** Called when speech starts. */
  onstarted = null;
  /** Called when speech ends. */
  onended = null;
  #lips = null;
  #loading = null; // a promise
  #weights = []; // last reported weights
  #isSpeaking = false; // last reported state

  /** @param context audio context of the sound */
  constructor(context) {
    super(context);
  }

  /** Load the models of this package; HeadAudio's own model is ignored. */
  loadModel() {
    this.#loading ??= this.#load().catch((error) => {
      this.#lips?.close();
      this.#lips = this.#loading = null;
      throw error;
    });
    return this.#loading;
  }

  async #load() {
    this.#lips = await LipSync.create({ context: this.context, shapes: ["oculus"] });
    this.#lips.addEventListener("voice", ({ detail: { timeS: t, isSpeaking } }) => {
      if (isSpeaking === this.#isSpeaking) return; // the laughter has changed
      this.#isSpeaking = isSpeaking;
      if (isSpeaking) this.onstarted?.({ event: "started", t });
      else this.onended?.({ event: "ended", t });
    });
    await this.start();
  }

  /** Report the weights that have changed. Call this method for each image. */
  update() {
    const weights = this.#lips?.current?.oculus ?? [];
    weights.forEach((weight, i) => {
      if (i > 0 && weight !== this.#weights[i]) this.onvalue?.(`viseme_${VISEMES[i]}`, weight);
    });
    this.#weights = weights;
  }

  /** Follow the sound. */
  async start() {
    if (this.#lips === null) throw new Error("the models are not loaded; call loadModel() first, which also starts");
    await this.#lips.listenTo(this);
  }

  /** Stop following the sound. */
  stop() {
    this.#lips?.stop();
  }
}

// "sil" is not reported: HeadAudio never reports it, and some avatars lack it.
const VISEMES = ["sil", "PP", "FF", "TH", "DD", "kk", "CH", "SS", "nn", "RR", "aa", "E", "I", "O", "U"];
