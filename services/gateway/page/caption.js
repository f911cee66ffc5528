// The caption below the face: syllables, or phones if the user chose them.

import { element } from "./elements.js";

const MAX_PHONES = 100;
const MAX_PAST = 8; // shown before the current phone
const SHOWN_AFTER_END_SAMPLES = 16000; // how long the last phone stays after its end
const FADE_SAMPLES = 16000; // how long it then fades
const SILENCE = "sil";
const SILENCE_SIGN = "·";

/** Stores the phones or syllables of a session, and returns those to show at a media time. */
export class PhoneTrack {
  #phones = []; // { index, symbol, text, begin, end }, by index

  reset() {
    this.#phones = [];
  }

  /**
   * Add a phone. The same index again revises the phone, or removes it if the revision is final and
   * has no duration. Times are in samples at 16 kHz.
   */
  add({ index, symbol, text = symbol, media_time: begin, duration, final }) {
    const phone = { index, symbol, text, begin, end: begin + duration };
    const known = this.#phones.findIndex((other) => other.index === index);
    if (final && duration === 0) this.#phones.splice(known, known >= 0 ? 1 : 0);
    else if (known >= 0) this.#phones[known] = phone;
    else this.#phones.push(phone);
    if (this.#phones.length > MAX_PHONES) this.#phones.shift();
  }

  get hasSpeech() {
    return this.#phones.some(({ symbol }) => symbol !== SILENCE);
  }

  /**
   * Return { current: text at a media time or the last one before it, past: the texts before it,
   * opacity: 0 to 1; at 0 nothing is current }.
   */
  at(mediaTime) {
    const started = this.#phones.filter(({ begin }) => begin <= mediaTime);
    const last = started.findLastIndex(({ symbol }) => symbol !== SILENCE);
    const remaining = last === -1 ? 0 : started[last].end + SHOWN_AFTER_END_SAMPLES + FADE_SAMPLES - mediaTime;
    const past = remaining > 0 ? started.slice(0, last) : started;
    return {
      current: remaining > 0 ? started[last].text : "",
      past: past.slice(-MAX_PAST).map(({ symbol, text }) => (symbol === SILENCE ? SILENCE_SIGN : text)),
      opacity: Math.max(0, Math.min(1, remaining / FADE_SAMPLES)),
    };
  }
}

export class Caption {
  #syllables = new PhoneTrack();
  #phones = new PhoneTrack();
  #preferences;

  /** @param {Preferences} preferences stores whether captions and phones are shown */
  constructor(preferences) {
    this.#preferences = preferences;
    const toggle = element("captions");
    toggle.checked = preferences.get("captions") ?? true;
    toggle.oninput = () => {
      preferences.set("captions", toggle.checked);
      this.#showOrHide();
    };
    this.#showOrHide();
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

  /** Whether the session has contained speech. */
  get hasSpeech() {
    return this.#phones.hasSpeech;
  }

  /** Start with a session of a language, given by its code; "": unknown. */
  reset(language) {
    this.#syllables.reset();
    this.#phones.reset();
    for (const name of ["spoken", "past"]) element(name).lang = language;
  }

  /** Add a "syllable" or "phone" message. */
  add(message) {
    (message.type === "phone" ? this.#phones : this.#syllables).add(message);
  }

  /** Show the caption of a media time. */
  show(mediaTime) {
    const track = this.#showsPhones ? this.#phones : this.#syllables;
    const { current, past, opacity } = track.at(mediaTime);
    for (const name of ["spoken", "past"]) element(name).style.opacity = opacity;
    if (this.text !== current) element("spoken").value = current;
    const key = past.join(" ");
    if (element("past").dataset.key !== key) {
      element("past").dataset.key = key;
      element("past").replaceChildren(...past.map(listItem));
    }
  }

  #showOrHide() {
    element("phones").hidden = !element("captions").checked;
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
