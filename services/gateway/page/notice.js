// The notice: what went wrong or happened, for a while, and otherwise what does not work.

import { element, setText } from "./elements.js";

const NEWS_MS = 8000; // for which an error, or what happened, stays to be read

const box = element("notice");

export class Notice {
  #timer = null;

  /** Say what went wrong ("error") or happened ("hint"). */
  tell(text, kind) {
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => (this.#timer = null), NEWS_MS);
    show(text, kind);
  }

  /** Show a hint, unless there is news; "" for none. */
  hint(text) {
    if (this.#timer === null) show(text, "hint");
  }
}

function show(text, kind) {
  box.dataset.kind = kind;
  box.hidden = text === "";
  setText(box, text);
}
