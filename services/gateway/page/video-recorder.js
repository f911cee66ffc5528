// Records the face and its sound as a video.

const VIDEO_RATE_HZ = 30;
// The first type that the browser supports is used. Other codecs in MP4 play in fewer programs.
const VIDEO_TYPES = ["video/mp4;codecs=avc1.42E01F,mp4a.40.2", "video/webm"];

/** Records a canvas and the session's sound with the browser's recorder. */
export class VideoRecorder {
  #sound;
  #recorder = null;
  #isStarting = false;

  /** @param {Sound} sound the session's sound */
  constructor(sound) {
    this.#sound = sound;
  }

  get isRecording() {
    return this.#recorder !== null;
  }

  /**
   * Start recording a canvas, unless it is already starting; onVideo(blob) receives the video.
   *
   * @returns a promise that is rejected if the browser cannot record
   */
  async start(canvas, onVideo) {
    if (this.#isStarting) return;
    this.#isStarting = true;
    try {
      const sound = await this.#sound.tap();
      const mimeType = VIDEO_TYPES.find((type) => MediaRecorder.isTypeSupported(type));
      const tracks = [...canvas.captureStream(VIDEO_RATE_HZ).getTracks(), ...sound.getTracks()];
      const recorder = new MediaRecorder(new MediaStream(tracks), { mimeType });
      const chunks = [];
      recorder.ondataavailable = ({ data }) => chunks.push(data);
      recorder.onstop = () => onVideo(new Blob(chunks, { type: mimeType }));
      recorder.start(1000);
      this.#recorder = recorder;
    } catch (error) {
      this.#sound.untap();
      throw error;
    } finally {
      this.#isStarting = false;
    }
  }

  /** Stop recording. */
  stop() {
    this.#recorder.stop();
    this.#recorder = null;
    this.#sound.untap();
  }
}
