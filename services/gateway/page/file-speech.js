// A file's speech as the stream of a microphone: decoded by this browser, in its sandbox.

const MAX_BYTES = 200 << 20;
const MAX_S = 3600;

/**
 * Return { stream, play(ended) } of a sound file, or of a video's sound.
 *
 * @throws { en, zh }: why it cannot be spoken
 */
export async function fileSpeech(context, file) {
  if (file.size > MAX_BYTES) {
    throw { en: "The file is larger than 200 MB.", zh: "文件大于 200 MB。" };
  }
  let buffer;
  try {
    buffer = await context.decodeAudioData(await file.arrayBuffer());
  } catch {
    throw {
      en: `This browser cannot read the sound of ${file.name}; kouxing speak reads more formats.`,
      zh: `浏览器无法解码 ${file.name}；可改用 kouxing speak，它支持更多格式。`,
    };
  }
  if (buffer.duration > MAX_S) {
    throw { en: "The file is longer than an hour.", zh: "文件超过一小时。" };
  }
  const source = new AudioBufferSourceNode(context, { buffer });
  const destination = new MediaStreamAudioDestinationNode(context, { channelCount: 1 });
  source.connect(destination);
  return {
    stream: destination.stream,
    play(ended) {
      source.onended = ended;
      source.start();
    },
  };
}
