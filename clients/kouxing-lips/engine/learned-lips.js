// Learned lips: lip positions and levels in, FAPs of the mouth out; services/synthesizer/lips/learned has
// the rules in model.py and closure_rule.py. The tongue stays at rest.

import { ClosingPhones, logOddsOf } from "./closing-phones.js";
import { clamp, smoothStep } from "./math.js";
import { RestingLips } from "./resting-lips.js";
import { LipTrack, Transition, add, stateAtRest } from "./trajectory.js";

export class LearnedLips {
  #model;
  #neutral;
  #delayS;
  #bilabials;
  #labiodentals;
  #queue = []; // lip positions that are not due yet
  #stable; // the last lip positions, stabilized
  #closing = [0, 0]; // closure fractions of the last two lip positions
  #hasLipPositions = false;
  #isSpeaking = false;
  #track;
  #onTrack; // the track at the last frame
  #transition;
  #transitionStartS = 0;
  #resting;
  #lateS = 0;
  #timeS = 0; // time of the last frame
  #mouth;

  constructor(model, delayS) {
    this.#model = model;
    this.#delayS = delayS;
    [this.#bilabials, this.#labiodentals] = ["b", "f"].map((viseme) => new ClosingPhones(model, viseme));
    this.#neutral = model.mouthFaps.map(() => 0);
    this.#stable = this.#neutral;
    this.#track = new LipTrack(this.#neutral, model.constants.track);
    this.#onTrack = this.#mouth = stateAtRest(this.#neutral);
    this.#transition = new Transition(stateAtRest(this.#neutral), 1);
    this.#resting = new RestingLips(model);
  }

  /** Add an event: { type: "lips", "speech", "progress" or "end", timeS, ... }. */
  addEvent(event) {
    this.#resting.addEvent(event);
    if (event.type === "speech") this.#isSpeaking = event.active;
    else if (event.type === "phone") for (const phones of [this.#bilabials, this.#labiodentals]) phones.add(event.phone);
    else if (event.type === "lips") {
      this.#queue.push(event);
      this.#hasLipPositions = true;
    }
  }

  /** Return the FAPs of the mouth at a media time, seconds; times increase. */
  frameAt(timeS) {
    this.#resting.followVoice(timeS);
    if (this.#hasLipPositions) this.#followTrack(timeS);
    const ajar = this.#resting.amountAt(timeS);
    this.#timeS = timeS;
    const { closures, learned, rest } = this.#model.constants;
    const faps = this.#mouth.value.slice();
    separateLips(faps, closures); // an interrupted closing movement overshoots
    faps.forEach((x, i) => (faps[i] = x + ajar * (rest.AJAR[i] - x)));
    for (const column of learned.UNTRACKED) faps[column] = 0;
    return faps;
  }

  #followTrack(timeS) {
    const continues = this.#track.endS >= this.#timeS;
    this.#extendTrack(timeS);
    const { TRANSITION_S, EPSILON } = this.#model.constants.learned;
    if (!continues) {
      const now = this.#track.at(this.#timeS);
      if (isDifferent(this.#onTrack, now, EPSILON)) {
        this.#transition = new Transition(add(this.#mouth, now, -1), TRANSITION_S);
        this.#transitionStartS = this.#timeS;
      }
    }
    this.#onTrack = this.#track.at(timeS);
    this.#mouth = add(this.#onTrack, this.#transition.at(timeS - this.#transitionStartS));
  }

  #extendTrack(timeS) {
    this.#track.forgetBefore(this.#timeS);
    const oldestS = timeS - this.#model.constants.learned.MEMORY_S;
    for (const phones of [this.#bilabials, this.#labiodentals]) phones.forgetBefore(oldestS);
    while (this.#queue.length && this.#track.endS < timeS) {
      const frame = this.#queue.shift();
      this.#track.append(frame.timeS, this.#stabilize(frame));
      this.#lateS = Math.max(0, frame.delayS - this.#delayS);
    }
    this.#track.holdS = this.#isSpeaking ? this.#model.constants.track.HOLD_S + this.#lateS : 0;
  }

  /** Return the FAPs of the next lip positions, stabilized and with closures. */
  #stabilize(frame) {
    const { JITTER_SQUARED, MAX_GAP_S, CLOSED_FRACTION, TEETH_LOG_ODDS } = this.#model.constants.learned;
    const { closures } = this.#model.constants;
    const rule = this.#model.closureRule;
    if (frame.timeS - this.#track.endS <= MAX_GAP_S) {
      this.#stable = this.#stable.map((x, i) => {
        const change = frame.faps[i] - x;
        return change === 0 ? x : x + change ** 3 / (change ** 2 + JITTER_SQUARED[i]);
      });
    } else {
      this.#closing = [0, 0];
      this.#stable = frame.faps;
    }
    const faps = this.#stable.slice();
    separateLips(faps, closures);
    const fractionOf = (logOdds) => smoothStep(0.5 + (0.5 * logOdds) / rule.doubt);
    const teeth = this.#labiodentals.logOddsAt(frame.timeS) - TEETH_LOG_ODDS;
    const phones = this.#bilabials.logOddsAt(frame.timeS);
    let closure = closureLogOdds(faps, logOddsOf(frame.closure, closures), phones, rule, closures);
    closure -= this.#resting.doubtAt(frame.timeS, frame.closure, phones);
    moveToRest(faps, fractionOf(teeth), closures.LOWER, closures.LOWER_OUTER);
    let closing = fractionOf(closure);
    const [before, newest] = this.#closing;
    if (before < CLOSED_FRACTION && CLOSED_FRACTION <= newest) closing = Math.max(closing, newest);
    this.#closing = [newest, closing];
    moveToRest(faps, closing, closures.INNER, closures.OUTER);
    return faps;
  }
}

/** Return the log odds of a closure: those from the sound, plus those that phones add. */
function closureLogOdds(faps, sound, phones, rule, c) {
  const opening = -(faps[c.INNER_UPPER] + faps[c.INNER_LOWER]);
  const width = faps[c.LEFT_CORNER] + faps[c.RIGHT_CORNER];
  const apart = rule.parted * (clamp(opening, c.PARTED, c.WIDE_APART) - c.PARTED);
  const narrow = rule.rounded * Math.max(0, c.ROUNDED - width);
  return rule.sound + sound + phones - (1 - phones / rule.phone) * (apart + narrow);
}

/** Separate lips that pass through each other, in place. */
function separateLips(faps, { UPPER, LOWER, BOTH }) {
  UPPER.forEach((upper, i) => {
    const crossed = Math.max(0, faps[upper] + faps[LOWER[i]]);
    for (const row of BOTH) faps[row[i]] -= 0.5 * crossed;
  });
}

/** Move inner lips toward rest, and the outer lips by the same distance, in place. */
function moveToRest(faps, amount, inner, outer) {
  inner.forEach((column, i) => {
    const shift = amount * faps[column];
    faps[column] -= shift;
    faps[outer[i]] -= shift;
  });
}

function isDifferent(state, other, epsilon) {
  const differs = (x, y) => x.some((value, i) => Math.abs(value - y[i]) > epsilon);
  return differs(state.value, other.value) || differs(state.velocity, other.velocity);
}
