// The voice of this browser's user: how the own mouth differs from anybody's, as the gateway learnt
// it. Pure code: the storage is handed in.

const KEY = "kouxing.voice";

/** Keeps the voice for this user, or only until the page is closed where nothing may be stored. */
export class VoiceStore {
  voice = null; // { profile (base64), learntOn (ms since 1970), before, after }; null: none
  #storage;

  /** @param storage the browser's, or null if there is none */
  constructor(storage) {
    this.#storage = storage;
    try {
      const voice = JSON.parse(storage?.getItem(KEY) ?? "null");
      if (typeof voice?.profile === "string" && voice.profile !== "") this.voice = voice;
    } catch {
      // what was not written here is no voice
    }
  }

  keep(voice) {
    this.voice = voice;
    try {
      this.#storage?.setItem(KEY, JSON.stringify(voice));
    } catch {
      // a full storage
    }
  }

  forget() {
    this.voice = null;
    this.#storage?.removeItem(KEY);
  }
}
