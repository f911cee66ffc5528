// Captures a stream's audio in chunks, with an audio worklet.

const MAX_RATE_HZ = 48000;

/** Return an audio context with a sample rate of at most 48 kHz. */
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
 * Capture a stream's audio.
 *
 * @param onChunk (samples: Int16Array of 20 ms, rms: level from 0 to 1, recordedMs: time of
 *   recording on the page's clock, correct even if the page was busy)
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
