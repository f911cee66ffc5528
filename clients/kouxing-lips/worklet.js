// Passes sound to the worker in blocks of about 10 ms. Runs in the audio thread.

const QUANTUM = 128; // samples per call
const BLOCK = QUANTUM * Math.max(1, Math.round(sampleRate / 100 / QUANTUM));

class LipSyncInput extends AudioWorkletProcessor {
  #block = new Float32Array(BLOCK);
  #numFilled = 0;
  #port = null; // of the worker
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
    if (this.#numFilled === BLOCK) {
      const samples = this.#block;
      this.#port.postMessage({ samples, endS: currentTime + QUANTUM / sampleRate }, [samples.buffer]);
      this.#block = new Float32Array(BLOCK);
      this.#numFilled = 0;
    }
    return true;
  }
}

registerProcessor("kouxing-lips", LipSyncInput);
