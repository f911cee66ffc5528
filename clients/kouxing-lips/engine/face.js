// The face of one session: events in, FAP frames out; services/synthesizer/face_animator.py has the
// rules.

import { Expressions, applyExpressiveness } from "./expressions.js";
import { Feeling } from "./feeling.js";
import { LearnedLips } from "./learned-lips.js";
import { NonverbalSounds } from "./nonverbal.js";

export class Face {
  #model;
  #delayS;
  #rateHz;
  #expressiveness;
  #lips;
  #expressions;
  #nonverbal;
  #feeling;
  #voice = []; // current and later progress
  #levels = []; // progress since the last frame
  #nextFrame = 0;
  #isSpeaking = false; // at the last frame
  #changes = []; // changes in future frames

  constructor(model, { delayS, expressiveness, feeling }) {
    this.#model = model;
    this.#delayS = delayS;
    this.#rateHz = model.defaults.frameRateHz;
    this.#expressiveness = expressiveness;
    this.#lips = new LearnedLips(model, delayS);
    this.#expressions = new Expressions(model);
    this.#nonverbal = new NonverbalSounds(model);
    this.#feeling = new Feeling(model, feeling);
  }

  express(strengths, holdS) {
    this.#expressions.show(strengths, holdS);
  }

  /** Process an event; return the frames { timeS, faps } that are now due. */
  process(event) {
    const { REST_S } = this.#model.constants.animator;
    if (event.type === "end") {
      const silence = { type: "speech", active: false, timeS: event.timeS };
      this.#lips.addEvent(silence);
      this.#changes.push(silence);
    }
    this.#lips.addEvent(event);
    if (event.type === "speech") this.#changes.push(event);
    if (event.type === "progress") {
      this.#voice.push(event);
      this.#levels.push(event);
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
    const { MOUTH, SPEECH_LEAD_S, VOICE_LEAD_S } = this.#model.constants.animator;
    while (this.#changes[0]?.timeS <= timeS) {
      const change = this.#changes.shift();
      this.#isSpeaking = change.active;
      if (change.active) this.#levels = this.#levels.filter((level) => level.timeS >= change.timeS); // earlier ones are noise
    }
    const startsSoon = this.#changes.some((change) => change.active && change.timeS <= timeS + SPEECH_LEAD_S);
    while (this.#voice[1]?.timeS <= timeS + VOICE_LEAD_S) this.#voice.shift();
    const voice = this.#voice[0];
    const stepS = 1 / this.#rateHz;
    const mouth = this.#lips.frameAt(timeS);
    const faps = new Float32Array(this.#model.numFaps);
    MOUTH.forEach((fap, i) => (faps[fap] = mouth[i]));
    applyExpressiveness(faps, this.#expressiveness, this.#model);
    const isSpeaking = this.#isSpeaking || startsSoon;
    this.#feeling.apply(faps, stepS, isSpeaking ? voice : null);
    this.#expressions.apply(faps, stepS, isSpeaking);
    const knownS = timeS + this.#delayS;
    this.#nonverbal.apply(faps, { timeS, knownS, stepS, isSpeaking, voice, levels: this.#levels });
    this.#levels = [];
    return { timeS, faps };
  }
}
