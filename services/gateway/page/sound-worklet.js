// Plays sound by its media time, inside the audio thread. The context runs at 16 kHz: media time =
// context frame + anchor. The anchor that is wanted moves all the time, for no two clocks run alike:
// what is near is glided to by resampling, which is not heard, and what is far by a leap.

const CAPACITY = 1 << 17; // samples, 8 s
const MASK = CAPACITY - 1; // of a media time: its place
const FADE = 1 / 64; // a step of the gain per sample: 4 ms against clicks
const LEAP = 160; // samples, 10 ms: from here on it is far
const NEAR = 1600; // samples in which a small distance shrinks to a third
const MAX_GLIDE = 0.01; // of the pace: a sixth of a semitone
const TAPS = 16; // of the filter between samples
const PHASES = 512; // places between two samples
const FILTER = filter();

/** Return the filter for each place between two samples: a windowed sinc. */
function filter() {
  const taps = new Float32Array((PHASES + 1) * TAPS);
  for (let i = 0; i < taps.length; i++) {
    const x = (i % TAPS) + 1 - TAPS / 2 - Math.floor(i / TAPS) / PHASES;
    const sinc = x === 0 ? 1 : Math.sin(Math.PI * x) / (Math.PI * x);
    taps[i] = sinc * Math.cos((Math.PI * x) / (TAPS + 2)) ** 2;
  }
  return taps;
}

class SoundPlayer extends AudioWorkletProcessor {
  #samples = new Float32Array(CAPACITY);
  #owner = new Float64Array(CAPACITY).fill(-1); // media time of the sample in each place
  #anchor = null;
  #wanted = null; // the anchor to get to
  #gain = 0;
  #numPlayed = 0;
  #reportedAt = 0;

  constructor() {
    super();
    this.port.onmessage = ({ data }) => {
      if (data.anchor !== undefined) this.#wanted = data.anchor;
      else this.#write(data.mediaTime, data.samples);
    };
  }

  #write(mediaTime, samples) {
    for (let i = 0; i < samples.length; i++) {
      const place = (mediaTime + i) & MASK;
      this.#samples[place] = samples[i] / 32768;
      this.#owner[place] = mediaTime + i;
    }
  }

  /** Return the sound at a media time that lies between samples; null if it is not there. */
  #at(media) {
    const [owner, samples] = [this.#owner, this.#samples];
    const first = Math.floor(media);
    if (owner[first & MASK] !== first) return null;
    const phase = Math.round((media - first) * PHASES) * TAPS;
    let value = 0;
    for (let i = 0; i < TAPS; i++) {
      const time = first + i + 1 - TAPS / 2;
      const place = time & MASK;
      if (owner[place] === time) value += FILTER[phase + i] * samples[place];
    }
    return value;
  }

  process(_inputs, [[output]]) {
    if (this.#wanted === null) return true;
    const far = this.#anchor === null ? Infinity : this.#wanted - this.#anchor;
    let leaps = Math.abs(far) > LEAP;
    const glide = leaps ? 0 : Math.max(-MAX_GLIDE, Math.min(MAX_GLIDE, far / NEAR));
    for (let i = 0; i < output.length; i++) {
      if (leaps && this.#gain === 0) {
        this.#anchor = this.#wanted;
        leaps = false;
      }
      this.#anchor += glide;
      const value = this.#at(currentFrame + i + this.#anchor);
      const open = value !== null && !leaps;
      this.#gain = open ? Math.min(1, this.#gain + FADE) : Math.max(0, this.#gain - FADE);
      output[i] = value * this.#gain;
      if (value !== null) this.#numPlayed++;
    }
    if (currentFrame - this.#reportedAt > sampleRate / 4) {
      this.#reportedAt = currentFrame;
      this.port.postMessage({ numPlayed: this.#numPlayed, anchor: this.#anchor });
    }
    return true;
  }
}

registerProcessor("sound-player", SoundPlayer);
