// The caption below the face: syllables, or phones if the user chose them.

import { element } from "./elements.js";
import { PhoneTrack } from "./phones.js";

export class Caption {
  #syllables = new PhoneTrack();
  #phones = new PhoneTrack();
  #preferences;

  /** @param {Preferences} preferences stores whether phones are shown */
  constructor(preferences) {
    this.#preferences = preferences;
    const button = element("show-phones");
    button.setAttribute("aria-pressed", this.#showsPhones);
    button.onclick = () => {
      preferences.set("phones", !this.#showsPhones);
      button.setAttribute("aria-pressed", this.#showsPhones);
    };
  }

  get text() {
    return element("spoken").value;
  }

  reset() {
    this.#syllables.reset();
    this.#phones.reset();
  }

  /** Add a "syllable" or "phone" message. */
  add(message) {
    (message.type === "phone" ? this.#phones : this.#syllables).add(message);
  }

  /** Show the caption of a media time. */
  show(mediaTime) {
    const { current, past } = (this.#showsPhones ? this.#phones : this.#syllables).at(mediaTime);
    if (this.text !== current) element("spoken").value = current;
    const key = past.join(" ");
    if (element("past").dataset.key !== key) {
      element("past").dataset.key = key;
      element("past").replaceChildren(...past.map(listItem));
    }
  }

  get #showsPhones() {
    return this.#preferences.get("phones") === true;
  }
}

function listItem(text) {
  const item = document.createElement("li");
  item.textContent = text;
  return item;
}
