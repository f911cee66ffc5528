// The notice at the top: recent news and errors, else a hint about a lasting problem.

import { element, setText } from "./elements.js";

const NEWS_MS = 8000; // for which news is shown

const box = element("notice");

export class Notice {
  #newsTimer = null;

  /** Show an "error", or news as a "hint", for some seconds. */
  showNews(text, kind) {
    clearTimeout(this.#newsTimer);
    this.#newsTimer = setTimeout(() => (this.#newsTimer = null), NEWS_MS);
    show(text, kind);
  }

  /** Show a hint unless news is shown; "" shows no hint. */
  showHint(text) {
    if (this.#newsTimer === null) show(text, "hint");
  }
}

function show(text, kind) {
  box.dataset.kind = kind;
  box.hidden = text === "";
  setText(box, text);
}
