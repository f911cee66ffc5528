// Expressions on a speaking face, and the size of mouth movements; shared/face/expression_motion.py
// and services/synthesizer/modifiers/expressiveness.py have the formulas.

import { clamp, smoothingGain } from "./math.js";
import { inRange } from "./options.js";

const MAX_HOLD_S = 3600; // as in the server

/** The current expressions of the face. */
export class Expressions {
  #constants;
  #easeS; // time constant of each filter pole
  #faps; // FAPs of each expression at full strength
  #numFaps;
  #goal;
  #halfway; // value between the two poles of the filter
  #shown;
  #isShown = false;
  #remainingS = 0;
  #lipWeight = 1;

  constructor({ arrays, constants, expressionNames, numFaps }, easeS = constants.expression.EASE_S) {
    this.#constants = constants.expression;
    this.#easeS = easeS;
    this.#numFaps = numFaps;
    this.#faps = Object.fromEntries(expressionNames.map((name) => [name, arrays[`expressions.${name}`].values]));
    this.#goal = this.#halfway = this.#shown = new Float32Array(numFaps);
  }

  /** Show expressions, strengths 0 to 1 by name, for a time; they replace earlier ones. */
  show(strengths, holdS) {
    const unknown = Object.keys(strengths).find((name) => !(name in this.#faps));
    if (unknown) throw new Error(`unknown expression ${unknown}; use ${Object.keys(this.#faps).join(", ")}`);
    inRange("holdS", holdS, 0, MAX_HOLD_S);
    let goal = new Float32Array(this.#numFaps);
    for (const [name, strength] of Object.entries(strengths)) {
      inRange(`expression ${name}`, strength, 0, 1);
      goal = goal.map((x, i) => x + strength * this.#faps[name][i]);
    }
    this.showFaps(goal, holdS);
  }

  /** Replace the expressions with FAPs (68,) for a time. */
  showFaps(goal, holdS) {
    [this.#goal, this.#remainingS] = [goal, holdS];
  }

  /** Add the expressions to a frame, in place. */
  apply(faps, stepS, isSpeaking) {
    const { FADE_S, FREE_S, BIND_S } = this.#constants;
    const isHeld = this.#remainingS > 0;
    this.#remainingS -= stepS;
    if (isSpeaking) this.#lipWeight = Math.max(this.#lipWeight - stepS / BIND_S, 0);
    else this.#lipWeight += (1 - this.#lipWeight) * smoothingGain(stepS, FREE_S);
    if (!isHeld && !this.#isShown) return;
    const gain = smoothingGain(stepS, isHeld ? this.#easeS : FADE_S);
    this.#halfway = this.#halfway.map((x, i) => x + gain * ((isHeld ? this.#goal[i] : 0) - x));
    this.#shown = this.#shown.map((x, i) => x + gain * (this.#halfway[i] - x));
    this.#mix(faps);
    this.#isShown = this.#shown.some((x) => Math.abs(x) > this.#constants.VISIBLE);
  }

  #mix(faps) {
    const { UPPER, LOWER, CLOSED, OPEN, WIDEST, WIDEST_JAW, JAW } = this.#constants;
    const added = this.#shown.slice();
    const gaps = UPPER.map((upper, i) => -(faps[upper] + faps[LOWER[i]]));
    const rooms = gaps.map((gap, i) => Math.min(gap, -faps[LOWER[i]], OPEN) - CLOSED);
    const half = rooms.length / 2; // inner lips first, then outer
    const apart = rooms.map((_, i) =>
      Math.max(Math.min(rooms[i % half], rooms[(i % half) + half]) / (OPEN - CLOSED), this.#lipWeight),
    );
    UPPER.forEach((upper, i) => {
      const lower = LOWER[i];
      const change = clamp(
        apart[i] * -(this.#shown[upper] + this.#shown[lower]),
        Math.min(CLOSED - gaps[i], 0),
        Math.max(WIDEST - gaps[i], 0),
      );
      const upwards = (this.#shown[lower] - this.#shown[upper]) / 2;
      const moved = upwards > 0 ? upwards : apart[i] * upwards;
      added[upper] = -moved - change / 2;
      added[lower] = moved - change / 2;
    });
    added[JAW] = Math.min(apart[0] * this.#shown[JAW], Math.max(WIDEST_JAW - faps[JAW], 0));
    added.forEach((x, i) => (faps[i] += x));
  }
}

/** Scale the mouth movements of a frame, in place; an amount of 1 changes nothing. */
export function applyExpressiveness(faps, amount, { constants: { expressiveness: c } }) {
  if (amount === 1) return;
  const growth = (opening) => {
    const more = amount - 1;
    if (more < 0) return more * opening;
    const within = Math.min(opening, c.WIDEST / 2);
    return more * within * (1 - within / c.WIDEST);
  };
  const { UPPER: uppers, LOWER: lowers } = c;
  const gap = -faps[uppers[0]] - faps[lowers[0]];
  let isOpen = 0;
  uppers.forEach((upper, i) => {
    const lower = lowers[i];
    const beyond = Math.max(-faps[upper] - faps[lower] - c.CLOSED, 0);
    const freeUpper = Math.max(-faps[upper] - c.CLOSED, 0);
    const freeLower = Math.max(-faps[lower] - c.CLOSED, 0);
    const free = freeUpper + freeLower;
    const apart = Math.min(freeLower / (c.OPEN - c.CLOSED), 1);
    if (i === 0) isOpen = apart * clamp((gap - c.CLOSED) / (c.OPEN - c.CLOSED), 0, 1);
    const grown = (apart * growth(Math.min(free, beyond))) / Math.max(free, 1);
    faps[upper] -= grown * freeUpper;
    faps[lower] -= grown * freeLower;
  });
  faps[c.JAW] += isOpen * growth(Math.max(faps[c.JAW], 0));
  const more = c.SIDEWAYS * (amount - 1);
  for (const fap of c.WIDTH) {
    const before = faps[fap];
    const width = before - c.USUAL_WIDTH;
    faps[fap] = Math.max(before + more * (width > 0 ? isOpen * width : width), Math.min(before, c.MIN_WIDTH));
  }
  for (const fap of c.PUSH) {
    const before = faps[fap];
    faps[fap] = Math.min(before + more * Math.max(before - c.USUAL_PUSH, 0), Math.max(before, c.MAX_PUSH));
  }
}
