// The canvas: it loads and draws heads, turns them with the arrow keys, and records videos.

import { element, setText } from "./elements.js";
import { Head } from "./head.js";
import { UserError, translate } from "./language.js";
import { drawingText, turnText } from "./status-texts.js";
import { VideoRecorder } from "./video-recorder.js";

const BACKGROUND = "#e9e8ea"; // the page's own background is not on the canvas
const TURN_DEGREES = {
  ArrowLeft: [10, 0],
  ArrowRight: [-10, 0],
  ArrowUp: [0, 10],
  ArrowDown: [0, -10],
  Home: [], // to the front
};

/** Save a video as a download; return its name. */
function save(video) {
  const link = document.createElement("a");
  const suffix = video.type.startsWith("video/mp4") ? "mp4" : "webm";
  link.download = `kouxing-${new Date().toISOString().slice(0, 19).replaceAll(":", "-")}.${suffix}`;
  link.href = URL.createObjectURL(video);
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
  return link.download;
}

export class Stage {
  #head = null; // null until it is loaded
  #chosen = ""; // name of the head that was chosen last
  #loading = Promise.resolve(); // done when it is loaded
  #faps;
  #handlers;
  #recorder;

  /**
   * @param faps 68 values that are updated before each call of draw
   * @param {Sound} sound for videos
   * @param handlers { loaded(), failed(text), toast(text) }
   */
  constructor(faps, sound, handlers) {
    this.#faps = faps;
    this.#recorder = new VideoRecorder(sound);
    this.#handlers = handlers;
    element("record").onclick = () => this.#toggleRecording();
    element("lower-frame-rate").onclick = () => this.#changeDrawRate((drawRate) => drawRate.halve());
    element("restore-frame-rate").onclick = () => this.#changeDrawRate((drawRate) => drawRate.restore());
    element("head").onkeydown = (event) => {
      if (this.#head === null || TURN_DEGREES[event.key] === undefined) return;
      event.preventDefault();
      setText(element("turned"), turnText(this.#head.turn(...TURN_DEGREES[event.key])));
    };
  }

  get isRecording() {
    return this.#recorder.isRecording;
  }

  /** How the head is drawn (Head.drawing); null before it is loaded. */
  get drawing() {
    return this.#head?.drawing ?? null;
  }

  get visibleDelayMs() {
    return this.#head?.drawRate.visibleDelayMs ?? 0;
  }

  /** Load a head by its name; "" for the gateway's default. */
  load(name) {
    this.#chosen = name;
    this.#loading = this.#loading.then(() => this.#load(name)); // in order: the last one stays
    return this.#loading;
  }

  /** Draw the face if it has changed. */
  draw(nowMs, hasChanged, onVisible) {
    if (hasChanged) this.#head?.pose(this.#faps);
    this.#head?.draw(nowMs, onVisible);
  }

  #changeDrawRate(change) {
    change(this.#head.drawRate);
    this.showDrawing();
  }

  /** Show a quality below the full one, and the buttons that change the image rate. */
  showDrawing() {
    if (this.#head === null) return;
    element("lower-frame-rate").hidden = !this.#head.drawRate.canHalve;
    element("restore-frame-rate").hidden = !this.#head.drawRate.isReduced;
    const text = drawingText(this.#head.drawing);
    element("head").title = text;
    setText(element("drawing"), text);
  }

  async #load(name) {
    if (name !== this.#chosen) return; // the user has chosen another one in the meantime
    element("loading").hidden = false;
    setText(element("no-head"), "");
    const file = name === "" ? "head.glb" : `head-${name}.glb`;
    try {
      const head = this.#head ?? makeHead();
      await head.load(file);
      this.#head = head;
      head.pose(this.#faps);
      head.draw(performance.now(), () => {}); // the first image takes long and is not measured
      this.#handlers.loaded();
    } catch (error) {
      const isText = error instanceof UserError;
      const text = isText ? error.message : translate("headMissing", { file, reason: error.message });
      this.#handlers.failed(text);
      if (this.#head === null) setText(element("no-head"), text); // stays after the notice has vanished
    }
    element("loading").hidden = true;
  }

  async #toggleRecording() {
    if (this.#recorder.isRecording) {
      this.#recorder.stop();
      this.#head.film(null);
    } else if (this.#head !== null) {
      this.#head.film(BACKGROUND);
      try {
        await this.#recorder.start(element("head"), (video) => {
          const file = save(video);
          this.#handlers.toast(translate(file.endsWith(".mp4") ? "videoSaved" : "webmSaved", { file }));
        });
      } catch (error) {
        this.#head.film(null);
        this.#handlers.failed(translate("recordingFailed", { reason: error.message }));
      }
    }
    element("record").setAttribute("aria-pressed", this.#recorder.isRecording);
  }
}

function makeHead() {
  try {
    const overlays = { controls: document.querySelector("footer"), panel: element("settings") };
    return new Head(element("head"), overlays);
  } catch {
    throw new UserError(translate("webGlMissing"));
  }
}
