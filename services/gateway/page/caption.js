// What is spoken, below the face: syllables, or phones on request.

import { element } from "./elements.js";
import { PhoneTrack } from "./phones.js";

export class Caption {
  #syllables = new PhoneTrack();
  #phones = new PhoneTrack();
  #choices;

  /** @param choices Choices, where "phones" is kept */
  constructor(choices) {
    this.#choices = choices;
    const button = element("show-phones");
    button.setAttribute("aria-pressed", this.#arePhonesShown);
    button.onclick = () => {
      choices.set("phones", !this.#arePhonesShown);
      button.setAttribute("aria-pressed", this.#arePhonesShown);
    };
  }

  get text() {
    return element("spoken").value;
  }

  reset() {
    this.#syllables.reset();
    this.#phones.reset();
  }

  /** Take a message, "syllable" or "phone". */
  accept(message) {
    (message.type === "phone" ? this.#phones : this.#syllables).accept(message);
  }

  /** Show what is spoken at a media time, and what was before. */
  show(mediaTime) {
    const { current, past } = (this.#arePhonesShown ? this.#phones : this.#syllables).at(mediaTime);
    if (this.text !== current) element("spoken").value = current;
    const key = past.join(" ");
    if (element("past").dataset.key !== key) {
      element("past").dataset.key = key;
      element("past").replaceChildren(...past.map(listItem));
    }
  }

  get #arePhonesShown() {
    return this.#choices.get("phones") === true;
  }
}

function listItem(text) {
  const item = document.createElement("li");
  item.textContent = text;
  return item;
}
