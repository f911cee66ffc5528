// Passes sound to the worker. Runs in the audio thread.
//
// A block ends when the engine can process the next frame, because messages cost more than the sound.

const QUANTUM = 128; // samples per call
const RATE_HZ = sampleRate;
const BLOCK_S = 0.02; // a frame of the engine
const RESAMPLER_DELAY_S = 0.002;

class LipSyncInput extends AudioWorkletProcessor {
  #block = new Float32Array(Math.ceil((BLOCK_S + RESAMPLER_DELAY_S) * RATE_HZ) + QUANTUM);
  #numFilled = 0;
  #numSent = 0; // samples
  #numBlocks = 0;
  #port = null; // port of the worker
  #isOpen = true;

  constructor() {
    super();
    this.port.onmessage = ({ data }) => {
      this.#port = data;
      this.#isOpen = data !== null;
    };
  }

  process([[input]]) {
    if (this.#port === null) return this.#isOpen;
    if (input === undefined) this.#block.fill(0, this.#numFilled, this.#numFilled + QUANTUM); // a paused source
    else this.#block.set(input, this.#numFilled);
    this.#numFilled += QUANTUM;
    const dueS = (this.#numBlocks + 1) * BLOCK_S + RESAMPLER_DELAY_S;
    if (this.#numSent + this.#numFilled >= dueS * RATE_HZ) {
      const samples = this.#block.slice(0, this.#numFilled);
      this.#port.postMessage({ samples, endS: currentTime + QUANTUM / RATE_HZ }, [samples.buffer]);
      this.#numSent += this.#numFilled;
      this.#numFilled = 0;
      this.#numBlocks++;
    }
    return true;
  }
}

registerProcessor("kouxing-lips", LipSyncInput);
