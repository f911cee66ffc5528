// The face of one session: events in, FAP frames out; services/synthesizer/face_animator.py has the
// rules.

import { Expressions, applyExpressiveness } from "./expressions.js";
import { LearntLips } from "./learnt-lips.js";

export class Face {
  #model;
  #delayS;
  #rateHz;
  #expressiveness;
  #lips;
  #expressions;
  #laughter;
  #hasLaughed = false;
  #nextFrame = 0;
  #isSpeaking = false; // at the last frame
  #changes = []; // of future frames

  constructor(model, { delayS, expressiveness }) {
    this.#model = model;
    this.#delayS = delayS;
    this.#rateHz = model.defaults.frameRateHz;
    this.#expressiveness = expressiveness;
    this.#lips = new LearntLips(model, delayS);
    this.#expressions = new Expressions(model);
    this.#laughter = new Expressions(model);
  }

  express(strengths, holdS) {
    this.#expressions.show(strengths, holdS);
  }

  /** Process an event; return the frames { timeS, faps } that are now due. */
  process(event) {
    const { REST_S, LAUGHTER_HOLD_S } = this.#model.constants.animator;
    if (event.type === "end") {
      const silence = { type: "speech", active: false, timeS: event.timeS };
      this.#lips.addEvent(silence);
      this.#changes.push(silence);
    }
    this.#lips.addEvent(event);
    if (event.type === "speech") this.#changes.push(event);
    if (event.isLaughter) {
      this.#laughter.show({ joy: 1 }, LAUGHTER_HOLD_S);
      this.#hasLaughed = true;
    }
    if (event.type === "end") return this.#framesUntil(event.timeS + this.#delayS + REST_S);
    return event.type === "progress" ? this.#framesUntil(event.timeS) : [];
  }

  #framesUntil(timeS) {
    const last = Math.floor((timeS - this.#delayS) * this.#rateHz + this.#model.constants.animator.ROUNDING);
    const frames = [];
    for (; this.#nextFrame <= last; this.#nextFrame++) frames.push(this.#makeFrame(this.#nextFrame / this.#rateHz));
    return frames;
  }

  #makeFrame(timeS) {
    const { MOUTH, SPEECH_LEAD_S } = this.#model.constants.animator;
    while (this.#changes[0]?.timeS <= timeS) this.#isSpeaking = this.#changes.shift().active;
    const startsSoon = this.#changes.some((change) => change.active && change.timeS <= timeS + SPEECH_LEAD_S);
    const mouth = this.#lips.frameAt(timeS);
    const faps = new Float32Array(this.#model.numFaps);
    MOUTH.forEach((fap, i) => (faps[fap] = mouth[i]));
    applyExpressiveness(faps, this.#expressiveness, this.#model);
    const isSpeaking = this.#isSpeaking || startsSoon;
    this.#expressions.apply(faps, 1 / this.#rateHz, isSpeaking);
    if (this.#hasLaughed) this.#laughter.apply(faps, 1 / this.#rateHz, isSpeaking);
    return { timeS, faps };
  }
}
