// What this browser's user has chosen, kept for the next visit. Pure code: the storage is handed in.

const KEY = "kouxing.choices";

/** Choices by name; what was not chosen is null. */
export class Choices {
  #storage;
  #values = {};

  /** @param storage the browser's, or null if there is none */
  constructor(storage) {
    this.#storage = storage;
    try {
      const values = JSON.parse(storage?.getItem(KEY) ?? "{}");
      if (typeof values === "object" && values !== null) this.#values = values;
    } catch {
      // what was not written here is no choice
    }
  }

  get(name) {
    return this.#values[name] ?? null;
  }

  set(name, value) {
    this.#values[name] = value;
    try {
      this.#storage?.setItem(KEY, JSON.stringify(this.#values));
    } catch {
      // a full storage
    }
  }
}
