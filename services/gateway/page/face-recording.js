// A recording to learn a mouth from: facial landmarks and sound, encoded as a landmark file
// (docs/my_mouth.md). Time, landmarks and sound are injected.

/** Landmarks of the face mesh that are kept. */
export const LANDMARKS = [
  0, 2, 4, 6, 10, 13, 14, 17, 33, 39, 54, 61, 67, 78, 81, 117, 119, 121, 127, 129, 133, 143, 152,
  178, 181, 198, 263, 269, 284, 291, 297, 308, 311, 346, 348, 350, 356, 358, 362, 372, 402, 405, 420,
];

const NO_FACE_MS = 1000; // without a face, until the user is advised
const QUIET_MS = 4000; // duration of quiet before the user gets advice
const QUIET_RMS = 0.005; // -46 dB of full scale
const MIN_LOUD = 0.1; // fraction of the chunks
const MIN_FACES = 0.7; // fraction of the images that must show a face

export class FaceRecording {
  static minRateHz = 4.5; // minimum rate of the images
  #rateHz;
  #chunks = [];
  #numSamples = 0;
  #numLoud = 0; // chunks
  #startMs = Infinity; // page's clock at the first sample
  #frames = []; // { ms, landmarks }
  #numImages = 0;
  #lastImageMs = null;
  #lastFaceMs = null;
  #lastLoudMs = null;

  constructor(rateHz) {
    this.#rateHz = rateHz;
  }

  /** Add sound (int16) that was recorded just now, and its level, 0 to 1. */
  addSound(nowMs, chunk, rms) {
    this.#chunks.push(chunk);
    this.#numSamples += chunk.length;
    // The minimum is the most accurate: a chunk can be delivered late, never early.
    this.#startMs = Math.min(this.#startMs, nowMs - (1000 * this.#numSamples) / this.#rateHz);
    this.#lastLoudMs ??= nowMs;
    if (rms < QUIET_RMS) return;
    this.#numLoud++;
    this.#lastLoudMs = nowMs;
  }

  /** Add the landmarks of an image (x, y, z each), or null if it shows no face. */
  addFace(takenMs, allLandmarks) {
    this.#numImages++;
    this.#lastImageMs = takenMs;
    this.#lastFaceMs ??= takenMs;
    if (allLandmarks === null) return;
    this.#lastFaceMs = takenMs;
    const landmarks = LANDMARKS.flatMap((i) => [...allLandmarks.subarray(3 * i, 3 * i + 3)]);
    this.#frames.push({ ms: takenMs, landmarks });
  }

  /** Return the text key of advice for the speaker, or null. */
  advice(nowMs) {
    if (this.#lastImageMs - this.#lastFaceMs > NO_FACE_MS) return "noFace";
    const isQuiet = this.#lastLoudMs !== null && nowMs - this.#lastLoudMs > QUIET_MS;
    return isQuiet ? "tooQuiet" : null;
  }

  /** Return the key of the text that says why nothing can be learned from the recording, or null. */
  problem() {
    if (this.#numImages === 0 || this.#frames.length < MIN_FACES * this.#numImages) return "noFace";
    if (this.#numLoud <= MIN_LOUD * this.#chunks.length) return "tooQuiet";
    const isSlow = this.#numImages < (FaceRecording.minRateHz * this.#numSamples) / this.#rateHz;
    return isSlow ? "tooSlow" : null;
  }

  /** Return the landmark file. */
  encode() {
    const frames = this.#frames.filter(
      ({ ms }, index, all) => ms >= this.#startMs && !(ms <= all[index - 1]?.ms),
    );
    const header = { times: frames.length, points: LANDMARKS.length, sample_rate_hz: this.#rateHz };
    const headerBytes = new TextEncoder().encode(JSON.stringify(header));
    const times = frames.map(({ ms }) => (ms - this.#startMs) / 1000);
    return new Blob([
      littleEndian(4, [headerBytes.length], "setUint32"),
      headerBytes,
      littleEndian(8, times, "setFloat64"),
      littleEndian(4, frames.flatMap(({ landmarks }) => landmarks), "setFloat32"),
      ...this.#chunks,
    ]);
  }
}

function littleEndian(numBytes, values, setter) {
  const view = new DataView(new ArrayBuffer(numBytes * values.length));
  values.forEach((value, index) => view[setter](numBytes * index, value, true));
  return view;
}
