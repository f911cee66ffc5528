// A browser's audio thread without the browser: runs one audio worklet over a sound, as fast as it
// can. Messages between a node and its processor arrive at once.

const SAMPLE_RATE_HZ = 48000;
const BLOCK = 128; // samples that a browser hands over at a time
export const ROW_MS = 10;

class Port {
  onmessage = null;
  other;

  postMessage(data) {
    this.other.onmessage?.({ data });
  }
}

const processors = new Map();
let processorPort; // of the processor that is being made

globalThis.sampleRate = SAMPLE_RATE_HZ;
globalThis.currentTime = 0;
globalThis.registerProcessor = (name, processor) => processors.set(name, processor);
globalThis.AudioWorkletProcessor = class {
  port = processorPort;
};
globalThis.AudioWorkletNode = class {
  constructor(_context, name, options) {
    this.port = new Port();
    processorPort = new Port();
    [this.port.other, processorPort.other] = [processorPort, this.port];
    const Processor = processors.get(name);
    this.processor = new Processor(options);
    this.parameterData = Object.fromEntries(
      Processor.parameterDescriptors.map((each) => [each.name, [each.defaultValue]]),
    );
  }
};

/**
 * Play a sound to a node. `onRow` is called at 0 s and every 10 ms of sound; by then the processor
 * has had every whole block up to that time, and nothing after it.
 */
export function play(node, samples, onRow) {
  const step = (SAMPLE_RATE_HZ * ROW_MS) / 1000;
  for (let start = 0, row = 0; row <= samples.length; start += BLOCK) {
    for (; row < start + BLOCK && row <= samples.length; row += step) onRow();
    globalThis.currentTime = start / SAMPLE_RATE_HZ;
    const block = new Float32Array(BLOCK);
    block.set(samples.subarray(start, start + BLOCK));
    node.processor.process([[block]], [], node.parameterData);
  }
}
