// Plays sound at its media time. Runs in the audio thread. The context runs at 16 kHz: media time =
// context frame + anchor. The target of the anchor moves all the time, because clocks drift. A small
// distance is corrected by resampling, which is inaudible, and a large one by a jump.

const CAPACITY_SAMPLES = 1 << 17; // 8 s
const MASK = CAPACITY_SAMPLES - 1; // maps a media time to its index
const FADE = 1 / 64; // change of the gain per sample; a fade takes 4 ms and avoids clicks
const MIN_JUMP_SAMPLES = 160; // 10 ms; smaller distances are corrected by resampling
const GLIDE_SAMPLES = 1600; // after which a small distance has shrunk to a third
const MAX_GLIDE = 0.01; // change of speed; a sixth of a semitone
const TAPS = 16; // length of the interpolation filter
const PHASES = 512; // positions between two samples
const FILTER = makeFilter();

/** Return a windowed sinc for each position between two samples. */
function makeFilter() {
  const taps = new Float32Array((PHASES + 1) * TAPS);
  for (let i = 0; i < taps.length; i++) {
    const x = (i % TAPS) + 1 - TAPS / 2 - Math.floor(i / TAPS) / PHASES;
    const sinc = x === 0 ? 1 : Math.sin(Math.PI * x) / (Math.PI * x);
    taps[i] = sinc * Math.cos((Math.PI * x) / (TAPS + 2)) ** 2;
  }
  return taps;
}

class SoundPlayer extends AudioWorkletProcessor {
  #samples = new Float32Array(CAPACITY_SAMPLES);
  #mediaTimes = new Float64Array(CAPACITY_SAMPLES).fill(-1); // media times of the samples
  #anchor = null;
  #target = null; // target of the anchor
  #gain = 0;
  #value = 0; // the newest sample; held while missing sound fades out
  #numPlayed = 0;
  #reportedAt = 0;

  constructor() {
    super();
    this.port.onmessage = ({ data }) => {
      if (data.anchor !== undefined) this.#target = data.anchor;
      else if (data.clear) this.#mediaTimes.fill(-1);
      else this.#write(data.mediaTime, data.samples);
    };
  }

  #write(mediaTime, samples) {
    for (let i = 0; i < samples.length; i++) {
      const index = (mediaTime + i) & MASK;
      this.#samples[index] = samples[i] / 32768;
      this.#mediaTimes[index] = mediaTime + i;
    }
  }

  /** Return the sound at a media time between samples; null if the sound is missing. */
  #at(media) {
    const [mediaTimes, samples] = [this.#mediaTimes, this.#samples];
    const first = Math.floor(media);
    if (mediaTimes[first & MASK] !== first) return null;
    const phase = Math.round((media - first) * PHASES) * TAPS;
    let value = 0;
    for (let i = 0; i < TAPS; i++) {
      const time = first + i + 1 - TAPS / 2;
      const index = time & MASK;
      if (mediaTimes[index] === time) value += FILTER[phase + i] * samples[index];
    }
    return value;
  }

  process(_inputs, [[output]]) {
    if (this.#target === null) return true;
    const distance = this.#anchor === null ? Infinity : this.#target - this.#anchor;
    let isJumping = Math.abs(distance) > MIN_JUMP_SAMPLES;
    const glide = isJumping ? 0 : Math.max(-MAX_GLIDE, Math.min(MAX_GLIDE, distance / GLIDE_SAMPLES));
    for (let i = 0; i < output.length; i++) {
      if (isJumping && this.#gain === 0) {
        this.#anchor = this.#target;
        isJumping = false;
      }
      this.#anchor += glide;
      const value = this.#at(currentFrame + i + this.#anchor);
      const isAudible = value !== null && !isJumping;
      this.#gain = isAudible ? Math.min(1, this.#gain + FADE) : Math.max(0, this.#gain - FADE);
      if (value !== null) {
        this.#value = value;
        this.#numPlayed++;
      }
      output[i] = this.#value * this.#gain;
    }
    if (currentFrame - this.#reportedAt > sampleRate / 4) {
      this.#reportedAt = currentFrame;
      this.port.postMessage({ numPlayed: this.#numPlayed, anchor: this.#anchor });
    }
    return true;
  }
}

registerProcessor("sound-player", SoundPlayer);
