// The user's preferences, stored for the next visit. The storage is injected.

const KEY = "kouxing.choices";

export class Preferences {
  #storage;
  #values = {};

  /** @param storage the browser's localStorage, or null */
  constructor(storage) {
    this.#storage = storage;
    try {
      const values = JSON.parse(storage?.getItem(KEY) ?? "{}");
      if (typeof values === "object" && values !== null) this.#values = values;
    } catch {
      // not written by this page
    }
  }

  /** Return a preference, or null. */
  get(name) {
    return this.#values[name] ?? null;
  }

  set(name, value) {
    this.#values[name] = value;
    try {
      this.#storage?.setItem(KEY, JSON.stringify(this.#values));
    } catch {
      // the storage is full
    }
  }
}
