// The caption below the face: syllables, or phones if the user chose them.

import { element } from "./elements.js";

const MAX_PHONES = 100;
const MAX_PAST = 8; // shown before the current phone
const SHOWN_AFTER_END = 8 * 16000; // samples for which the last phone is still shown
const SILENCE = "sil";
const SILENCE_SIGN = "·";

/** The phones or syllables of a session, and which of them to show at a media time. */
export class PhoneTrack {
  #phones = []; // { index, symbol, begin, end }, by index

  reset() {
    this.#phones = [];
  }

  /**
   * Add a phone. The same index again revises the phone, or removes it if the revision is final and
   * has no duration. Times are in samples at 16 kHz.
   */
  add({ index, symbol, media_time: begin, duration, final }) {
    const phone = { index, symbol, begin, end: begin + duration };
    const known = this.#phones.findIndex((other) => other.index === index);
    if (final && duration === 0) this.#phones.splice(known, known >= 0 ? 1 : 0);
    else if (known >= 0) this.#phones[known] = phone;
    else this.#phones.push(phone);
    if (this.#phones.length > MAX_PHONES) this.#phones.shift();
  }

  /** Return { current: symbol at a media time or "", past: the symbols before it }. */
  at(mediaTime) {
    const current = this.#phones.findLastIndex((phone) => phone.begin <= mediaTime);
    const phone = this.#phones[current];
    const isOver =
      phone === undefined || phone.symbol === SILENCE || mediaTime > phone.end + SHOWN_AFTER_END;
    const numPast = isOver ? current + 1 : current;
    const past = this.#phones.slice(Math.max(0, current - MAX_PAST), Math.max(0, numPast));
    return {
      current: isOver ? "" : phone.symbol,
      past: past.map(({ symbol }) => (symbol === SILENCE ? SILENCE_SIGN : symbol)),
    };
  }
}

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
