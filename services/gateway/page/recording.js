// What a mouth is learnt from: landmarks of the face and the sound, as a landmark file
// (docs/my_mouth.md). Pure code: time, landmarks and sound are handed in.

/** Those of the face mesh's landmarks that are kept. */
export const LANDMARKS = [
  0, 2, 4, 6, 10, 13, 14, 17, 33, 39, 54, 61, 67, 78, 81, 117, 119, 121, 127, 129, 133, 143, 152,
  178, 181, 198, 263, 269, 284, 291, 297, 308, 311, 346, 348, 350, 356, 358, 362, 372, 402, 405, 420,
];

export const NO_FACE = {
  en: "No face is seen: sit before the camera, with light on your face.",
  zh: "看不到脸：请正对摄像头，脸部要有光。",
};
export const TOO_QUIET = {
  en: "Hardly anything is heard: speak up, or turn the microphone up.",
  zh: "声音太小：请大声一点，或调高麦克风音量。",
};
export const TOO_SLOW = {
  en: "This computer follows too few pictures a second: close other programs and try again.",
  zh: "这台电脑处理画面太慢：请关闭其他程序再试。",
};

const NO_FACE_MS = 1000; // without a face before it is said
const QUIET_MS = 4000; // of quiet before it is said
const QUIET_RMS = 0.005; // -46 dB of full scale
const MIN_LOUD = 0.1; // share of the sound
const MIN_SEEN = 0.7; // share of the pictures with a face
const MIN_RATE_HZ = 10; // of the pictures: lips move on within a tenth of a second

export class FaceRecording {
  #rateHz;
  #chunks = [];
  #numSamples = 0;
  #numLoud = 0; // chunks
  #startMs = Infinity; // page's clock at the first sample
  #frames = []; // { ms, landmarks }
  #numPictures = 0;
  #seenMs = null; // when a face was seen last
  #heardMs = null; // when it was loud last

  constructor(rateHz) {
    this.#rateHz = rateHz;
  }

  /** Add sound, int16, that was recorded just now, and its level, 0 to 1. */
  addSound(nowMs, chunk, rms) {
    this.#chunks.push(chunk);
    this.#numSamples += chunk.length;
    // The least difference seen is the truest: a chunk can be handed over late, never early.
    this.#startMs = Math.min(this.#startMs, nowMs - (1000 * this.#numSamples) / this.#rateHz);
    this.#heardMs ??= nowMs;
    if (rms < QUIET_RMS) return;
    this.#numLoud++;
    this.#heardMs = nowMs;
  }

  /** Add what was found in a picture: all landmarks of the face, x y z each, or null. */
  addFace(takenMs, all) {
    this.#numPictures++;
    this.#seenMs ??= takenMs;
    if (all === null) return;
    this.#seenMs = takenMs;
    const landmarks = LANDMARKS.flatMap((index) => [...all.subarray(3 * index, 3 * index + 3)]);
    this.#frames.push({ ms: takenMs, landmarks });
  }

  /** Return what the speaker should do otherwise at the moment, in both languages; null if all is well. */
  advice(nowMs) {
    if (nowMs - this.#seenMs > NO_FACE_MS) return NO_FACE;
    return nowMs - this.#heardMs > QUIET_MS ? TOO_QUIET : null;
  }

  /** Return why nothing can be learnt from all this, in both languages; null if it can. */
  problem() {
    if (this.#numPictures === 0 || this.#frames.length < MIN_SEEN * this.#numPictures) return NO_FACE;
    if (this.#numLoud < MIN_LOUD * this.#chunks.length) return TOO_QUIET;
    return this.#numPictures < (MIN_RATE_HZ * this.#numSamples) / this.#rateHz ? TOO_SLOW : null;
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

function littleEndian(numBytes, values, set) {
  const view = new DataView(new ArrayBuffer(numBytes * values.length));
  values.forEach((value, index) => view[set](numBytes * index, value, true));
  return view;
}
