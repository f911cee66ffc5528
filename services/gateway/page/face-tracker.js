// The face in pictures, found in a frame of its own; see face-mesh.js.

const LOADING_LIMIT_MS = 60000;

export class FaceTracker {
  lips = []; // pairs of landmarks that a line of the lips joins
  #frame = document.createElement("iframe");
  #waiting = null; // { resolve, reject } of the answer that is to come
  #onMessage = (event) => this.#receive(event);

  /** Load the tracker; an Error says what is wrong. */
  async load() {
    addEventListener("message", this.#onMessage);
    this.#frame.src = "face-mesh.html";
    this.#frame.tabIndex = -1;
    document.body.append(this.#frame);
    const timer = setTimeout(() => this.#fail("it does not answer"), LOADING_LIMIT_MS);
    ({ lips: this.lips } = await this.#answer());
    clearTimeout(timer);
  }

  /** Return the landmarks, x y z in pixels each, of the face in a picture; null if it has none. */
  async find(picture) {
    this.#frame.contentWindow.postMessage(picture, location.origin, [picture]);
    return (await this.#answer()).landmarks;
  }

  close() {
    removeEventListener("message", this.#onMessage);
    this.#frame.remove();
    this.#fail("it was closed");
  }

  #answer() {
    return new Promise((resolve, reject) => (this.#waiting = { resolve, reject }));
  }

  #receive({ data, source }) {
    if (source !== this.#frame.contentWindow) return;
    if (data.problem === undefined) this.#waiting?.resolve(data);
    else this.#fail(data.problem);
  }

  #fail(text) {
    this.#waiting?.reject(new Error(`no face can be found here: ${text}`));
  }
}
