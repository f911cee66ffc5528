// Collects the microphone in chunks of 20 ms of int16, inside the audio thread.

class Capture extends AudioWorkletProcessor {
  #chunk = new Int16Array(Math.round(sampleRate / 50));
  #filled = 0;
  #squares = 0;

  process([[input]]) {
    if (input === undefined) return true;
    for (const value of input) {
      this.#squares += value * value;
      this.#chunk[this.#filled++] = Math.max(-32768, Math.min(32767, Math.round(value * 32767)));
      if (this.#filled === this.#chunk.length) {
        const chunk = this.#chunk.slice();
        const rms = Math.sqrt(this.#squares / chunk.length);
        this.port.postMessage({ chunk, rms, recordedMs: Date.now() }, [chunk.buffer]);
        this.#filled = 0;
        this.#squares = 0;
      }
    }
    return true;
  }
}

registerProcessor("capture", Capture);
