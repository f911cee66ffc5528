// The phones of a session, or its syllables. Pure code: nothing is drawn.

const MAX_PHONES = 100;
const MAX_SHOWN = 8; // beside the current one
const SHOWN_AFTER_END = 8 * 16000; // samples for which the last phone is still shown
const SILENCE = "sil";
const SILENCE_SIGN = "·";

/** Phones, or syllables, as they come and are revised, and which of them are shown at a media time. */
export class PhoneTrack {
  #phones = []; // { index, symbol, begin, end }, by index

  reset() {
    this.#phones = [];
  }

  /**
   * Take a phone; the same index again revises it, or withdraws it if it is final and has no duration.
   * Times are in samples at 16 kHz.
   */
  accept({ index, symbol, media_time: begin, duration, final }) {
    const phone = { index, symbol, begin, end: begin + duration };
    const known = this.#phones.findIndex((other) => other.index === index);
    if (final && duration === 0) this.#phones.splice(known, known >= 0 ? 1 : 0);
    else if (known >= 0) this.#phones[known] = phone;
    else this.#phones.push(phone);
    if (this.#phones.length > MAX_PHONES) this.#phones.shift();
  }

  /** Return the symbol that is spoken at a media time ("": none), and those before it. */
  at(mediaTime) {
    const current = this.#phones.findLastIndex((phone) => phone.begin <= mediaTime);
    const phone = this.#phones[current];
    const isOver =
      phone === undefined || phone.symbol === SILENCE || mediaTime > phone.end + SHOWN_AFTER_END;
    const numPast = isOver ? current + 1 : current;
    const past = this.#phones.slice(Math.max(0, current - MAX_SHOWN), Math.max(0, numPast));
    return {
      current: isOver ? "" : phone.symbol,
      past: past.map(({ symbol }) => (symbol === SILENCE ? SILENCE_SIGN : symbol)),
    };
  }
}
