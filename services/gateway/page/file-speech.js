// The speech of a file as an audio stream. The browser decodes the file in its sandbox.

import { UserError, say } from "./language.js";

const MAX_BYTES = 200 << 20;
const MAX_S = 3600;

/**
 * Return { stream, play(onEnded) } for a sound file or the sound of a video.
 *
 * @throws {UserError} if the file is too large, too long or cannot be decoded
 */
export async function openFileSpeech(context, file) {
  if (file.size > MAX_BYTES) throw new UserError(say("fileTooLarge"));
  let buffer;
  try {
    buffer = await context.decodeAudioData(await file.arrayBuffer());
  } catch {
    throw new UserError(say("fileUnreadable", { file: file.name }));
  }
  if (buffer.duration > MAX_S) throw new UserError(say("fileTooLong"));
  const source = new AudioBufferSourceNode(context, { buffer });
  const destination = new MediaStreamAudioDestinationNode(context, { channelCount: 1 });
  source.connect(destination);
  return {
    stream: destination.stream,
    play(onEnded) {
      source.onended = onEnded;
      source.start();
    },
  };
}
