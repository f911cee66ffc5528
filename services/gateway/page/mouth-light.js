// Light on teeth and tongue, computed as in services/driver/render/renderer.py.

const DEPTH = 500; // distance from the lips at rest to the teeth, FAP units (MNS / 1024)
const SPREAD = 0.25;
const MIN_LIGHT = 0.08;

/** Return the light for 68 FAPs, as a fraction from 0 to 1. */
export function mouthLight(faps) {
  const height = Math.max(-(faps[3] + faps[4]), 0);
  const depth = Math.max(DEPTH + (faps[15] + faps[16]) / 2, 0);
  return Math.min(1, MIN_LIGHT + height / (height + (SPREAD * depth ** 2) / DEPTH + 1e-6));
}
