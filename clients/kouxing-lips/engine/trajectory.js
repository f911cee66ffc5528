// Position and velocity of values, transitions between trajectories, and the track of lip positions;
// services/synthesizer/lips has the formulas in trajectory.py and learned/lip_track.py.

/** Return a state { value, velocity } at rest. */
export function stateAtRest(value) {
  return { value, velocity: value.map(() => 0) };
}

/** Return a state plus a factor times another. */
export function add(state, other, factor = 1) {
  const [value, velocity] = [state.value.slice(), state.velocity.slice()];
  for (let i = 0; i < value.length; i++) {
    value[i] += factor * other.value[i];
    velocity[i] += factor * other.velocity[i];
  }
  return { value, velocity };
}

/** Blends a difference, a state, to zero along a cubic. */
export class Transition {
  #difference;
  #durationS;

  constructor(difference, durationS) {
    this.#difference = difference;
    this.#durationS = durationS;
  }

  /** Return the remaining difference, a state. */
  at(elapsedS) {
    const { value, velocity } = this.#difference;
    const durationS = this.#durationS;
    const u = Math.min(elapsedS / durationS, 1);
    return {
      value: value.map((x, i) => (1 - u) ** 2 * ((1 + 2 * u) * x + u * durationS * velocity[i])),
      velocity: velocity.map((v, i) => (1 - u) * ((-6 * u * value[i]) / durationS + (1 - 3 * u) * v)),
    };
  }
}

/** A mouth trajectory from lip positions; it starts at rest. */
export class LipTrack {
  holdS = 0;
  #rest;
  #constants;
  #knots = []; // { timeS, state }

  constructor(neutral, constants) {
    this.#rest = stateAtRest(neutral);
    this.#constants = constants;
  }

  get endS() {
    return this.#knots.at(-1)?.timeS ?? -Infinity;
  }

  append(timeS, faps) {
    const { MAX_GAP_S, CLOSE_S, OPEN_S } = this.#constants;
    let velocity = faps.map(() => 0);
    if (timeS - this.endS <= MAX_GAP_S) {
      const { value } = this.#knots.at(-1).state;
      velocity = faps.map((x, i) => (x - value[i]) / (timeS - this.endS));
    } else {
      if (this.#knots.length) this.#knots.push({ timeS: this.endS + CLOSE_S, state: this.#rest });
      this.#knots.push({ timeS: timeS - OPEN_S, state: this.#rest });
    }
    this.#knots.push({ timeS, state: { value: faps, velocity } });
  }

  forgetBefore(timeS) {
    this.#knots.splice(0, Math.max(0, numKnotsUntil(this.#knots, timeS) - 1));
  }

  at(timeS) {
    let knots = this.#knots;
    if (!knots.length || timeS < knots[0].timeS) return this.#rest;
    if (timeS >= knots.at(-1).timeS) knots = [knots.at(-1), ...this.#returnToRest()];
    const after = numKnotsUntil(knots, timeS);
    return after === knots.length ? this.#rest : interpolate(knots[after - 1], knots[after], timeS);
  }

  #returnToRest() {
    const rest = { timeS: this.endS + this.holdS + this.#constants.CLOSE_S, state: this.#rest };
    if (this.holdS === 0) return [rest];
    return [{ timeS: this.endS + this.holdS, state: stateAtRest(this.#knots.at(-1).state.value) }, rest];
  }
}

/** Return the number of knots up to a time. */
function numKnotsUntil(knots, timeS) {
  const after = knots.findIndex((knot) => knot.timeS > timeS);
  return after < 0 ? knots.length : after;
}

/** Return the cubic Hermite spline between two knots at a time. */
function interpolate(before, after, timeS) {
  const durationS = after.timeS - before.timeS;
  const u = (timeS - before.timeS) / durationS;
  const [start, end] = [before.state, after.state];
  const step = end.value.map((x, i) => x - start.value[i]);
  return {
    value: start.value.map(
      (x, i) =>
        x +
        u * u * (3 - 2 * u) * step[i] +
        u * (1 - u) * durationS * ((1 - u) * start.velocity[i] - u * end.velocity[i]),
    ),
    velocity: start.velocity.map(
      (v, i) => (6 * u * (1 - u) * step[i]) / durationS + (1 - u) * (1 - 3 * u) * v + u * (3 * u - 2) * end.velocity[i],
    ),
  };
}
