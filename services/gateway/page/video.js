// A video of what is seen and heard, by the browser's own recorder. It shows the chosen head from the
// side that was turned to, needs no driver, and goes to the user's downloads.

export const BACKGROUND = "#e9e8ea"; // the page's own is no part of the canvas
const RATE_HZ = 30;
// The first that this browser can write.
const TYPES = ["video/mp4;codecs=avc1.42E01F,mp4a.40.2", "video/mp4", "video/webm"];

export class VideoRecorder {
  #recorder = null;

  get isRecording() {
    return this.#recorder !== null;
  }

  /** Begin to record a canvas and a stream of sound. */
  start(canvas, sound) {
    const type = TYPES.find((each) => MediaRecorder.isTypeSupported(each));
    const tracks = [...canvas.captureStream(RATE_HZ).getTracks(), ...sound.getTracks()];
    this.#recorder = new MediaRecorder(new MediaStream(tracks), { mimeType: type });
    const parts = [];
    this.#recorder.ondataavailable = ({ data }) => parts.push(data);
    this.#recorder.onstop = () => save(new Blob(parts, { type }));
    this.#recorder.start(1000);
  }

  /** End, and hand the video to the user. */
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
