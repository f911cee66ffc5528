// Plays sound by its media time, inside the audio thread. The context runs at 16 kHz, so a sample
// of the session is a sample of the context: media time = context frame + anchor.

const CAPACITY = 1 << 17; // samples, 8 s
const FADE = 1 / 64; // a step of the gain per sample: 4 ms against clicks

class SoundPlayer extends AudioWorkletProcessor {
  #samples = new Float32Array(CAPACITY);
  #owner = new Float64Array(CAPACITY).fill(-1); // media time of the sample in each place
  #anchor = null;
  #next = null; // the anchor to change to, once the sound has faded out
  #gain = 0;
  #numPlayed = 0;
  #reportedAt = 0;

  constructor() {
    super();
    this.port.onmessage = ({ data }) => {
      if (data.anchor !== undefined) this.#next = data.anchor;
      else this.#write(data.mediaTime, data.samples);
    };
  }

  #write(mediaTime, samples) {
    for (let i = 0; i < samples.length; i++) {
      const place = (mediaTime + i) % CAPACITY;
      this.#samples[place] = samples[i] / 32768;
      this.#owner[place] = mediaTime + i;
    }
  }

  process(_inputs, [[output]]) {
    for (let i = 0; i < output.length; i++) {
      if (this.#next !== null && (this.#anchor === null || this.#gain === 0)) {
        this.#anchor = this.#next;
        this.#next = null;
      }
      const media = this.#anchor === null ? -1 : currentFrame + i + this.#anchor;
      const place = media < 0 ? 0 : media % CAPACITY;
      const there = media >= 0 && this.#owner[place] === media;
      const open = there && this.#next === null;
      this.#gain = open ? Math.min(1, this.#gain + FADE) : Math.max(0, this.#gain - FADE);
      output[i] = there ? this.#samples[place] * this.#gain : 0;
      if (there) this.#numPlayed++;
    }
    if (currentFrame - this.#reportedAt > sampleRate / 4) {
      this.#reportedAt = currentFrame;
      this.port.postMessage(this.#numPlayed);
    }
    return true;
  }
}

registerProcessor("sound-player", SoundPlayer);
