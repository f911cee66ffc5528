// Lips in pauses; services/synthesizer/lips/learned/resting_lips.py has the rules.

import { Transition } from "./trajectory.js";

/** Tracks how far the mouth is ajar in one session. */
export class RestingLips {
  #constants;
  #levels = []; // levels of future frames: [time s, dB]
  #changes = []; // changes in future frames
  #isVoice = false;
  #hasSpoken = false;
  #hasEnded = false;
  #loudestDb = -Infinity;
  #backgroundDb = 0;
  #numLevels = 0;
  #onsetUntilS = -Infinity;
  #knownS = -Infinity;
  #soundS = -Infinity;
  #staysClosed = false;
  #isClosedByPhone = false;
  #timeS = Infinity;
  #goal = 0;
  #transition = transitionTo(0, 0, 0, 1);
  #elapsedS = 0;

  constructor({ constants }) {
    this.#constants = constants.rest;
  }

  addEvent(event) {
    if (event.type === "progress") {
      if (this.#knownS === -Infinity) this.#soundS = event.timeS;
      this.#levels.push([event.timeS, event.levelDb]);
      this.#loudestDb = Math.max(event.levelDb, this.#loudestDb - this.#constants.FADE_DB);
      this.#knownS = event.timeS;
    } else if (event.type === "speech") this.#changes.push(event);
    else if (event.type === "end") this.#hasEnded = true;
  }

  /** Process the events up to the time of a frame; times increase. */
  followVoice(timeS) {
    while (this.#changes[0]?.timeS <= timeS) {
      const change = this.#changes.shift();
      if (change.active && !this.#isVoice) [this.#soundS, this.#staysClosed] = [change.timeS, false];
      this.#isVoice = change.active;
      this.#hasSpoken ||= change.active;
    }
    while (this.#levels[0]?.[0] <= timeS) {
      const [levelS, levelDb] = this.#levels.shift();
      this.#updateBackground(levelDb);
      if (this.#isSound(levelDb)) [this.#soundS, this.#staysClosed] = [levelS, false];
    }
  }

  /** Return the log odds that silence subtracts from a closure, given those that phones add. */
  doubtAt(timeS, closure, phones) {
    const c = this.#constants;
    this.#isClosedByPhone = phones > 0;
    if (this.#isClosedByPhone) return 0;
    const nextS = this.#nextSoundS();
    const isSilent = this.#isVoice && this.#knownS > timeS + c.LAST_SOUND_S && nextS > this.#knownS;
    const isOnset = c.YIELD_S < nextS - timeS && nextS - timeS <= c.LIKELY_BEFORE_S;
    if (closure >= (isOnset ? c.LIKELY : c.CERTAIN)) {
      this.#staysClosed ||= isSilent || isOnset;
      return 0;
    }
    if (this.#goal > 0) return Infinity;
    return isSilent ? c.DOUBT : 0;
  }

  /** Return the amount at the time of a frame. */
  amountAt(timeS) {
    const c = this.#constants;
    const nextS = this.#nextSoundS();
    if (this.#hasEnded) this.#setGoal(0, c.END_S);
    else if (this.#changes.some((change) => change.active && change.timeS <= timeS + c.LEAD_S)) this.#setGoal(1, c.PART_S);
    else if (this.#isClosedByPhone || this.#staysClosed || nextS <= timeS + c.YIELD_S) this.#setGoal(0, c.YIELD_S);
    else if (this.#closesForOnset(timeS)) this.#setGoal(0, c.ONSET_CLOSE_S);
    else if (timeS > this.#soundS + c.HOLD_S) this.#setGoal(0, c.CLOSE_S);
    else if (!this.#isVoice || Math.min(nextS, this.#knownS) >= this.#soundS + c.MIN_PAUSE_S) this.#setGoal(1, c.PART_S);
    this.#elapsedS += Math.max(timeS - this.#timeS, 0);
    this.#timeS = timeS;
    return this.#amount();
  }

  /** Return whether an onset before the first voice activity closes the lips. */
  #closesForOnset(timeS) {
    const c = this.#constants;
    if (this.#hasSpoken || this.#numLevels < c.NUM_FIRST_LEVELS) return false;
    if (timeS > this.#onsetUntilS) {
      const onsetDb = this.#backgroundDb + c.ONSET_DB;
      const endS = timeS + c.ONSET_LEAD_S;
      if (this.#levels.some(([levelS, db]) => levelS <= endS && db > onsetDb)) this.#onsetUntilS = timeS + c.ONSET_S;
    }
    return timeS <= this.#onsetUntilS;
  }

  #updateBackground(level) {
    const c = this.#constants;
    const levelDb = Math.max(level, c.MIN_BACKGROUND_DB);
    this.#numLevels += 1;
    if (this.#numLevels <= c.NUM_FIRST_LEVELS) {
      this.#backgroundDb += (levelDb - this.#backgroundDb) / this.#numLevels;
      return;
    }
    const difference = levelDb - this.#backgroundDb;
    this.#backgroundDb += difference > c.ONSET_DB ? c.BACKGROUND_RISE_DB : c.BACKGROUND_RATE * difference;
  }

  #isSound(levelDb) {
    return this.#isVoice && levelDb >= this.#loudestDb - this.#constants.RANGE_DB;
  }

  #nextSoundS() {
    return this.#levels.find(([, db]) => this.#isSound(db))?.[0] ?? Infinity;
  }

  #setGoal(goal, durationS) {
    if (goal === this.#goal) return;
    this.#transition = transitionTo(goal, this.#amount(), this.#transition.at(this.#elapsedS).velocity[0], durationS);
    [this.#goal, this.#elapsedS] = [goal, 0];
  }

  #amount() {
    return this.#goal + this.#transition.at(this.#elapsedS).value[0];
  }
}

function transitionTo(goal, amount, velocity, durationS) {
  return new Transition({ value: [amount - goal], velocity: [velocity] }, durationS);
}
