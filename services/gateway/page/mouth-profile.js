// The mouth profile of this browser's user, which the gateway learned. The storage is injected.

const KEY = "kouxing.voice"; // the name under which browsers have stored profiles from the start

/** Keeps the mouth profile in the storage, or until the page closes if nothing can be stored. */
export class MouthProfileStore {
  current = null; // { profile (base64), learntOn (ms since 1970), before, after } or null
  #storage;

  /** @param storage the browser's localStorage, or null */
  constructor(storage) {
    this.#storage = storage;
    try {
      const stored = JSON.parse(storage?.getItem(KEY) ?? "null");
      if (typeof stored?.profile === "string" && stored.profile !== "") this.current = stored;
    } catch {
      // not written by this page
    }
  }

  keep(profile) {
    this.current = profile;
    try {
      this.#storage?.setItem(KEY, JSON.stringify(profile));
    } catch {
      // the storage is full
    }
  }

  forget() {
    this.current = null;
    this.#storage?.removeItem(KEY);
  }
}
