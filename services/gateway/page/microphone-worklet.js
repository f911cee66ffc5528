// Collects the microphone's sound in int16 chunks of 20 ms. Runs in the audio thread.

class CaptureProcessor extends AudioWorkletProcessor {
  #chunk = new Int16Array(Math.round(sampleRate / 50));
  #numFilled = 0;
  #squares = 0;

  process([[input]]) {
    if (input === undefined) return true;
    for (const value of input) {
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
