// Laughter and breaths of the voice on the face; services/synthesizer/modifiers/nonverbal.py has the
// formulas.

import { Expressions } from "./expressions.js";

export class NonverbalSounds {
  #constants;
  #laughter;
  #breath;
  #levels = []; // progress events that have not acted yet
  #loudestDb = -Infinity;
  #loudness = 0;

  constructor(model) {
    this.#constants = model.constants.nonverbal;
    this.#laughter = new Expressions(model, this.#constants.LAUGH_EASE_S);
    this.#breath = new Expressions(model);
  }

  /**
   * Add laughter and breath to a frame, in place.
   *
   * @param frame { timeS, knownS: the audio is known up to here, stepS, isSpeaking,
   *   voice: traits or undefined, levels: new progress events }
   */
  apply(faps, { timeS, knownS, stepS, isSpeaking, voice, levels }) {
    const { HOLD_S, LEAD_S, LOUDNESS_DB, FORGET_DB_S, BREATH, SMILING, LOUD_NOTE } = this.#constants;
    this.#levels.push(...levels);
    this.#loudestDb -= FORGET_DB_S * stepS;
    while (this.#levels[0]?.timeS <= Math.min(knownS, timeS + LEAD_S)) {
      const { levelDb } = this.#levels.shift();
      this.#loudestDb = Math.max(this.#loudestDb, levelDb);
      this.#loudness = Math.max(1 + (levelDb - this.#loudestDb) / LOUDNESS_DB, 0);
    }
    if (voice?.isLaughter) {
      this.#laughter.showFaps(SMILING.map((x, i) => x + this.#loudness * LOUD_NOTE[i]), HOLD_S);
    } else if (voice?.isBreath) this.#breath.showFaps(BREATH, HOLD_S);
    this.#laughter.apply(faps, stepS, isSpeaking);
    this.#breath.apply(faps, stepS, isSpeaking);
  }
}
