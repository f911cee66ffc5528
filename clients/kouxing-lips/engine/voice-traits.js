// Feeling, laughter and breath in a voice; services/recognizer/live/voice_traits.py has the formulas.

import { clamp } from "./math.js";

export class VoiceTraits {
  /** Traits of the voice at the newest encoder frame. */
  newest = { arousal: 0, valence: 0, isLaughter: false, isBreath: false };
  #constants;
  #voices;
  #weights;
  #bias;
  #feeling; // arousal and valence
  #mean;
  #numVoiced = 0;
  #evidence = [0, 0]; // evidence of laughter and of breath
  #encoderFramesSinceLaugh;

  constructor({ arrays, constants, voices }) {
    this.#constants = constants.traits;
    this.#voices = voices;
    this.#encoderFramesSinceLaugh = this.#constants.LAUGH_ENCODER_FRAMES;
    this.#weights = arrays["traits.weights"];
    this.#bias = arrays["traits.bias"].values;
    this.#feeling = this.#mean = [...arrays["traits.mean"].values];
  }

  /** Process the next encoder frame's state and probabilities of the kinds of voice. */
  accept(state, voice) {
    const { MIN_VOICE, VOICE_PRIOR_WEIGHT, VOICE_MEMORY, FEELING_PRIOR_WEIGHT, FEELING_MEMORY, EVIDENCE_FRACTION } = this.#constants;
    const { values, shape: [, numOutputs] } = this.#weights;
    const outputs = new Float64Array(this.#bias);
    for (let i = 0, at = 0; i < state.length; i++) {
      const value = state[i];
      for (let output = 0; output < numOutputs; output++, at++) outputs[output] += value * values[at];
    }
    const smooth = (current, gain) => current.map((value, i) => value + gain * (outputs[i] - value));
    if (voice[this.#voices.SPEECH] + voice[this.#voices.SUNG] > MIN_VOICE) {
      this.#numVoiced++;
      this.#mean = smooth(this.#mean, 1 / Math.min(this.#numVoiced + VOICE_PRIOR_WEIGHT, VOICE_MEMORY));
      this.#feeling = smooth(this.#feeling, 1 / Math.min(this.#numVoiced + FEELING_PRIOR_WEIGHT, FEELING_MEMORY));
    }
    this.#evidence = this.#evidence.map((value, i) => value + EVIDENCE_FRACTION * (outputs[2 + i] - value));
    const [arousal, valence] = this.#feeling.map((value, i) => this.#rounded(clamp(value - this.#mean[i], -1, 1)));
    const isLaugh = voice[this.#voices.LAUGHTER] > this.#constants.MIN_LAUGHTER;
    this.#encoderFramesSinceLaugh = isLaugh ? 0 : this.#encoderFramesSinceLaugh + 1;
    const isDetected = (evidence, wasDetected) => evidence > (wasDetected ? this.#constants.STOP : this.#constants.START);
    this.newest = {
      arousal,
      valence,
      isLaughter:
        isDetected(this.#evidence[0], this.newest.isLaughter) && this.#encoderFramesSinceLaugh < this.#constants.LAUGH_ENCODER_FRAMES,
      isBreath: isDetected(this.#evidence[1], this.newest.isBreath),
    };
  }

  #rounded(value) {
    const scale = 10 ** this.#constants.DIGITS;
    return Math.round(scale * value) / scale;
  }
}
