// Moves the face with the arousal and valence of the voice; services/synthesizer/modifiers/feeling.py
// has the values.

import { applyExpressiveness } from "./expressions.js";
import { clamp, smoothingGain } from "./math.js";

export class Feeling {
  #model;
  #amount;
  #halfway = [0, 0]; // arousal and valence in the two-pole filter
  #shown = [0, 0];

  constructor(model, amount) {
    this.#model = model;
    this.#amount = amount;
  }

  /** Add the feeling to a frame, in place; `voice` is null without speech. */
  apply(faps, stepS, voice) {
    const { GAIN, FILTER_S, SIZE, AROUSED, TIRED, PLEASANT, UNPLEASANT } = this.#model.constants.feeling;
    const goal = voice ? [voice.arousal ?? 0, voice.valence ?? 0] : [0, 0];
    const gain = smoothingGain(stepS, FILTER_S);
    this.#halfway = this.#halfway.map((x, i) => x + gain * (this.#amount * clamp(GAIN * goal[i], -1, 1) - x));
    this.#shown = this.#shown.map((x, i) => x + gain * (this.#halfway[i] - x));
    const [arousal, valence] = this.#shown;
    applyExpressiveness(faps, 1 + SIZE * arousal, this.#model);
    const [excited, pleased] = [arousal > 0 ? AROUSED : TIRED, valence > 0 ? PLEASANT : UNPLEASANT];
    for (let i = 0; i < faps.length; i++) faps[i] += Math.abs(arousal) * excited[i] + Math.abs(valence) * pleased[i];
  }
}
