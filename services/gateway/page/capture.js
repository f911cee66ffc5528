// A stream's microphone in chunks, by an audio worklet.

const MAX_RATE_HZ = 48000;

/** Return an audio context in which a microphone can be captured, of at most 48 kHz. */
export async function openCaptureContext() {
  let context = new AudioContext({ latencyHint: "interactive" });
  if (context.sampleRate > MAX_RATE_HZ) {
    context.close();
    context = new AudioContext({ latencyHint: "interactive", sampleRate: MAX_RATE_HZ });
  }
  await context.audioWorklet.addModule("microphone-worklet.js");
  return context;
}

/**
 * Hand over a stream's microphone: onChunk(samples, int16, of 20 ms, their level, 0 to 1, and when
 * they were recorded, ms of the page's clock, however long this page was busy since).
 */
export function capture(context, stream, onChunk) {
  const node = new AudioWorkletNode(context, "capture", {
    numberOfOutputs: 0,
    channelCount: 1,
    channelCountMode: "explicit",
  });
  node.port.onmessage = ({ data: { chunk, rms, recordedMs } }) =>
    onChunk(chunk, rms, performance.now() - (Date.now() - recordedMs));
  context.createMediaStreamSource(stream).connect(node);
  context.resume();
}
