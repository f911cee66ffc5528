// The newest frames, from which the face at any time is interpolated.

const MAX_S = 60; // older frames are dropped

export class FrameTrack {
  #frames = []; // by ascending time

  /** Append frames { timeS, faps, ... } of the engine. */
  push(frames) {
    for (const frame of frames) this.#frames.push(frame); // may be too many for spread arguments
    const first = this.#frames.findIndex(({ timeS }) => timeS >= this.#frames.at(-1).timeS - MAX_S);
    this.#frames.splice(0, first);
  }

  /** Time of the newest frame, seconds; minus infinity before the first. */
  get endS() {
    return this.#frames.at(-1)?.timeS ?? -Infinity;
  }

  /** Return the face at a time, or the nearest one; null before the first frame. */
  at(timeS) {
    const frames = this.#frames;
    if (frames.length === 0) return null;
    let after = frames.length; // the newest frames are near the end
    while (after > 0 && frames[after - 1].timeS > timeS) after--;
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
