// Collects the microphone's sound in int16 chunks of 20 ms, at no more than 48 kHz. Runs in the audio thread.

class CaptureProcessor extends AudioWorkletProcessor {
  #step = Math.ceil(sampleRate / 48000); // between two samples that are kept
  #chunk = new Int16Array(Math.round(sampleRate / this.#step / 50));
  #numFilled = 0;
  #numSkipped = 0;
  #squares = 0;

  process([[input]]) {
    if (input === undefined) return true;
    for (const value of input) {
      this.#numSkipped = (this.#numSkipped + 1) % this.#step;
      if (this.#numSkipped > 0) continue;
      this.#squares += value * value;
      this.#chunk[this.#numFilled++] = Math.max(-32768, Math.min(32767, Math.round(value * 32768)));
      if (this.#numFilled === this.#chunk.length) {
        const chunk = this.#chunk.slice();
        const rms = Math.sqrt(this.#squares / chunk.length);
        this.port.postMessage({ chunk, rms, recordedMs: Date.now() }, [chunk.buffer]);
        this.#numFilled = 0;
        this.#squares = 0;
      }
    }
    return true;
  }
}

registerProcessor("capture", CaptureProcessor);
