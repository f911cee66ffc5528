// Small functions that several modules use.

export function sigmoid(x) {
  return 0.5 * Math.tanh(0.5 * x) + 0.5;
}

export function clamp(x, lowest, highest) {
  return Math.min(Math.max(x, lowest), highest);
}

/** Map 0 to 1 onto 0 to 1 with a slope of 0 at both ends; other values are clipped. */
export function smoothStep(x) {
  x = clamp(x, 0, 1);
  return x * x * (3 - 2 * x);
}

/** Return the fraction of a change that a one-pole low-pass filter makes in a time, 0 to 1. */
export function smoothingGain(elapsedS, timeConstantS) {
  return -Math.expm1(-elapsedS / timeConstantS);
}

/** Apply a function to each value of an array. Float32Array.from() takes ten times longer. */
export function floats(values, compute) {
  const out = new Float32Array(values.length);
  for (let i = 0; i < out.length; i++) out[i] = compute(values[i]);
  return out;
}

/** Concatenate arrays. */
export function join(parts) {
  const joined = new Float32Array(parts.reduce((sum, { length }) => sum + length, 0));
  let at = 0;
  for (const part of parts) {
    joined.set(part, at);
    at += part.length;
  }
  return joined;
}

/** Return a time in whole samples of media time. */
export function wholeSamples(timeS, { constants: { clock } }) {
  return Math.round(timeS * clock.MEDIA_RATE_HZ) / clock.MEDIA_RATE_HZ;
}

/** Return the media time of a feature frame: half an overlap after the start of its window. */
export function frameTimeS(frame, model) {
  const { HOP_S, WINDOW_S } = model.constants.segmenter;
  return wholeSamples(frame * HOP_S + (WINDOW_S - HOP_S) / 2, model);
}

/** Convert the bits of a 16-bit floating-point number. */
export function halfToFloat(half) {
  const sign = half & 0x8000 ? -1 : 1;
  const exponent = (half >> 10) & 31;
  const fraction = (half & 1023) / 1024;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? (1 + fraction) * 2 ** (exponent - 15) : fraction * 2 ** -14);
}
