// The audio thread of a browser in Node: runs an audio worklet over a recording, as fast as possible. Messages
// between a node and its processor arrive immediately. The clock is the duration of the audio so far.

export const SAMPLE_RATE_HZ = 48000;
export const BLOCK = 128; // samples

class Port {
  onmessage = null;
  peer;

  postMessage(data) {
    this.peer.onmessage?.({ data });
  }
}

const processors = new Map();
let processorPort; // port of the processor that is being constructed

globalThis.sampleRate = SAMPLE_RATE_HZ;
globalThis.currentTime = 0;
globalThis.performance.now = () => 1000 * globalThis.currentTime;
globalThis.registerProcessor = (name, processor) => processors.set(name, processor);
globalThis.AudioWorkletProcessor = class {
  port = processorPort;
};
globalThis.AudioWorkletNode = class {
  constructor(_context, name, options) {
    this.port = new Port();
    processorPort = new Port();
    [this.port.peer, processorPort.peer] = [processorPort, this.port];
    const Processor = processors.get(name);
    this.processor = new Processor(options);
    this.parameterData = Object.fromEntries(
      (Processor.parameterDescriptors ?? []).map(({ name: parameter, defaultValue }) => [parameter, [defaultValue]]),
    );
  }
};

/**
 * Pass a recording to `processBlock` in blocks of 128 samples. After every `stepS`, `makeRow` returns the values of
 * a row. The rows start with their time: the length of the audio so far, in seconds.
 */
export function runBlocks(samples, stepS, processBlock, makeRow) {
  const rows = [];
  globalThis.currentTime = 0;
  for (let start = 0; start < samples.length; start += BLOCK) {
    const block = new Float32Array(BLOCK);
    block.set(samples.subarray(start, start + BLOCK));
    processBlock(block);
    globalThis.currentTime = (start + BLOCK) / SAMPLE_RATE_HZ;
    if (globalThis.currentTime >= rows.length * stepS) rows.push([globalThis.currentTime, ...makeRow()]);
  }
  return rows;
}
