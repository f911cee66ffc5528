// Finds the face in images. The work is done in a separate frame; see face-mesh.js.

import { UserError, translate } from "./language.js";

const LOADING_TIMEOUT_MS = 60000;

export class FaceTracker {
  lips = []; // pairs of landmarks that are joined by the outline of the lips
  #frame = document.createElement("iframe");
  #pending = null; // { resolve, reject } of the next answer
  #onMessage = (event) => this.#receive(event);

  /** Load the tracker. Throws a UserError if it cannot run. */
  async load() {
    addEventListener("message", this.#onMessage);
    this.#frame.src = "face-mesh.html";
    this.#frame.tabIndex = -1;
    document.body.append(this.#frame);
    const timer = setTimeout(() => this.#fail("timeout"), LOADING_TIMEOUT_MS);
    try {
      ({ lips: this.lips } = await this.#nextAnswer());
    } finally {
      clearTimeout(timer);
    }
  }

  /** Return the landmarks of the face in an image (x, y, z in pixels), or null without a face. */
  async find(image) {
    this.#frame.contentWindow.postMessage(image, location.origin, [image]);
    return (await this.#nextAnswer()).landmarks;
  }

  close() {
    removeEventListener("message", this.#onMessage);
    this.#frame.remove();
    this.#fail("closed");
  }

  #nextAnswer() {
    return new Promise((resolve, reject) => (this.#pending = { resolve, reject }));
  }

  #receive({ data, source }) {
    if (source !== this.#frame.contentWindow) return;
    if (data.problem === undefined) this.#pending?.resolve(data);
    else this.#fail(data.problem);
  }

  #fail(reason) {
    this.#pending?.reject(new UserError(translate("trackerFailed", { reason })));
  }
}
