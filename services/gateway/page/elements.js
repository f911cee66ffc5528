// Access to the page's elements.

import { translate } from "./language.js";

export function element(id) {
  return document.getElementById(id);
}

/** Set an element's text if it differs. Screen readers announce every change. */
export function setText(target, text) {
  if (target.textContent !== text) target.textContent = text;
}

/** Give an element another text of the table; it changes with the page's language. */
export function setTextKey(target, key) {
  target.dataset.text = key;
  setText(target, translate(key));
}
