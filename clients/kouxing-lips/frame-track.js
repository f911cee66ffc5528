// The newest frames, from which the face at any time is interpolated.

export class FrameTrack {
  #frames = []; // by ascending time
  #durationS;

  /** Frames older than a duration are dropped. */
  constructor(durationS) {
    this.#durationS = durationS;
  }

  /** Append frames { timeS, faps, ... } of the engine. */
  push(frames) {
    for (const frame of frames) this.#frames.push(frame); // may be too many for spread arguments
    const startS = this.endS - this.#durationS;
    this.#frames.splice(0, this.#frames.findIndex(({ timeS }) => timeS >= startS));
  }

  /** Time of the newest frame, seconds; minus infinity before the first. */
  get endS() {
    return this.#frames.at(-1)?.timeS ?? -Infinity;
  }

  /** Return the face at a time, or the nearest one; null before the first frame. */
  at(timeS) {
    const frames = this.#frames;
    if (frames.length === 0) return null;
    let [first, after] = [0, frames.length]; // the first frame after the time is in this range
    while (first < after) {
      const middle = Math.floor((first + after) / 2);
      if (frames[middle].timeS > timeS) after = middle;
      else first = middle + 1;
    }
    if (after === 0) return frames[0];
    if (after === frames.length) return frames.at(-1);
    return mix(frames[after - 1], frames[after], timeS);
  }
}

function mix(before, after, timeS) {
  const fraction = (timeS - before.timeS) / (after.timeS - before.timeS);
  const mixed = { ...before, timeS };
  for (const name of Object.keys(before)) {
    const [from, to] = [before[name], after[name]];
    if (!(from instanceof Float32Array)) continue;
    const values = new Float32Array(from.length);
    for (let i = 0; i < values.length; i++) values[i] = from[i] + fraction * (to[i] - from[i]);
    mixed[name] = values;
  }
  return mixed;
}
