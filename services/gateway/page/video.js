// Records the canvas and the sound as a video, with the browser's recorder. The video is saved as a
// download.

export const BACKGROUND = "#e9e8ea"; // the page's own background is not on the canvas
const RATE_HZ = 30;
// The first type that the browser supports is used.
const TYPES = ["video/mp4;codecs=avc1.42E01F,mp4a.40.2", "video/mp4", "video/webm"];

export class VideoRecorder {
  #recorder = null;

  get isRecording() {
    return this.#recorder !== null;
  }

  /** Start recording a canvas and an audio stream. */
  start(canvas, sound) {
    const mimeType = TYPES.find((type) => MediaRecorder.isTypeSupported(type));
    const tracks = [...canvas.captureStream(RATE_HZ).getTracks(), ...sound.getTracks()];
    this.#recorder = new MediaRecorder(new MediaStream(tracks), { mimeType });
    const chunks = [];
    this.#recorder.ondataavailable = ({ data }) => chunks.push(data);
    this.#recorder.onstop = () => save(new Blob(chunks, { type: mimeType }));
    this.#recorder.start(1000);
  }

  /** Stop recording and save the video. */
  stop() {
    this.#recorder.stop();
    this.#recorder = null;
  }
}

function save(video) {
  const link = document.createElement("a");
  const suffix = video.type.startsWith("video/mp4") ? "mp4" : "webm";
  link.download = `kouxing-${new Date().toISOString().slice(0, 19).replaceAll(":", "-")}.${suffix}`;
  link.href = URL.createObjectURL(video);
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}
