// The notice at the top of the page: toasts, and hints about lasting problems.

import { element, setText } from "./elements.js";

const TOAST_MS = 8000; // how long a toast is shown
const SHOWN_AFTER_MS = 1000; // shorter faults are not shown

/** Shows the hint of a fault only if the fault lasts, and reports its end. Time is injected. */
export class PersistentFault {
  #sinceMs = null;
  #isShown = false;

  /** Take the current hint, "" without a fault; return { hint: to be shown, isOver }. */
  update(nowMs, hint) {
    if (hint === "") {
      const isOver = this.#isShown;
      this.#sinceMs = null;
      this.#isShown = false;
      return { hint, isOver };
    }
    this.#sinceMs ??= nowMs;
    this.#isShown ||= nowMs - this.#sinceMs > SHOWN_AFTER_MS;
    return { hint: this.#isShown ? hint : "", isOver: false };
  }
}

/** The notice at the top: for some seconds a toast, otherwise a hint about a lasting problem. */
export class Notice {
  #toastTimer = null;

  /** Show a toast, in the color of an "error" or a "hint". */
  showToast(text, kind) {
    clearTimeout(this.#toastTimer);
    this.#toastTimer = setTimeout(() => (this.#toastTimer = null), TOAST_MS);
    showNotice(text, kind);
  }

  /** Remove the toast. */
  clear() {
    clearTimeout(this.#toastTimer);
    this.#toastTimer = null;
    this.showHint("");
  }

  /** Show a hint unless a toast is shown; "" shows no hint. */
  showHint(text) {
    if (this.#toastTimer === null) showNotice(text, "hint");
  }
}

function showNotice(text, kind) {
  const box = element("notice");
  box.dataset.kind = kind;
  box.hidden = text === "";
  setText(box, text);
}
