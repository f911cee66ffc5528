// Captures the audio of a microphone or a file in chunks, with an audio worklet.

import { pathWithToken } from "./address.js";
import { UserError, translate, translateResponse } from "./language.js";

const MAX_RATE_HZ = 48000;
// The lowpass before samples are dropped. It reduces frequencies that would alias to 8 kHz or lower by 33 dB or more.
const CUTOFF_HZ = 16000;
const BUTTERWORTH_Q_DB = [-5.33, 2.32]; // of 4th order
const MAX_FILE_BYTES = 200 << 20;
const QUIET_PEAK = 1e-3; // a file whose peak is lower (-60 dBFS) is called silent

/**
 * Return an audio context at the device's rate. Firefox captures no microphone at another rate.
 *
 * @throws {UserError} if the gateway, which has the worklet, does not answer
 */
export async function openCaptureContext() {
  const context = new AudioContext({ latencyHint: "interactive" });
  try {
    await context.audioWorklet.addModule("microphone-worklet.js");
  } catch {
    context.close();
    throw new UserError(translate("gatewaySilent"));
  }
  return context;
}

/** Return the sample rate of captured audio: at most 48 kHz, and a fraction of the context's rate. */
export function captureRateHz({ sampleRate }) {
  return sampleRate / Math.ceil(sampleRate / MAX_RATE_HZ);
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
  let source = context.createMediaStreamSource(stream);
  if (captureRateHz(context) < context.sampleRate) {
    for (const Q of BUTTERWORTH_Q_DB) {
      source = source.connect(new BiquadFilterNode(context, { type: "lowpass", frequency: CUTOFF_HZ, Q }));
    }
  }
  source.connect(node);
  context.resume();
}

/** Return whether the browser can read a file; it cannot read a folder or a file that was moved. */
function isReadable(file) {
  return file.slice(0, 1).arrayBuffer().then(
    () => true,
    () => false,
  );
}

/**
 * Return { name, stream, remarks, play(onEnded) } for an audio file or the sound of a video. The gateway
 * decodes it, as browsers ignore gaps in timestamps and read fewer formats.
 *
 * @throws {UserError} if the file is too large, too long or silent, or cannot be read or decoded
 */
export async function openFileSpeech(context, file) {
  if (file.size > MAX_FILE_BYTES) throw new UserError(translate("fileTooLarge"));
  let response;
  try {
    response = await fetch(pathWithToken("sound", { name: file.name }), { method: "POST", body: file });
  } catch {
    throw new UserError(await isReadable(file) ? translate("gatewaySilent") : translate("fileUnreadable", { file: file.name }));
  }
  if (!response.ok) throw new UserError(await translateResponse(response));
  const buffer = await context.decodeAudioData(await response.arrayBuffer());
  if (buffer.getChannelData(0).every((sample) => Math.abs(sample) < QUIET_PEAK)) {
    throw new UserError(translate("noSpeechSilent", { file: file.name }));
  }
  const source = new AudioBufferSourceNode(context, { buffer });
  const destination = new MediaStreamAudioDestinationNode(context, { channelCount: 1 });
  source.connect(destination);
  return {
    name: file.name,
    stream: destination.stream,
    remarks: decodeURIComponent(response.headers.get("Kouxing-Remarks") ?? ""),
    play(onEnded) {
      source.onended = onEnded;
      source.start();
    },
  };
}
