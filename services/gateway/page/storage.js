// Stores the user's choices for the next visit. The browser's localStorage is injected as a function; it
// throws if the browser forbids it.

/** A value in the storage. It lasts until the page closes if nothing can be stored. */
class StoredValue {
  #storage;
  #key;

  constructor(storage, key) {
    this.#storage = storage;
    this.#key = key;
  }

  read() {
    try {
      return JSON.parse(this.#storage().getItem(this.#key));
    } catch {
      return null; // not written by this page
    }
  }

  /** Store a value; null deletes it. */
  write(value) {
    try {
      if (value === null) this.#storage().removeItem(this.#key);
      else this.#storage().setItem(this.#key, JSON.stringify(value));
    } catch {
      // the storage is full or forbidden
    }
  }
}

/** The user's preferences. */
export class Preferences {
  #stored;
  #values;

  constructor(storage) {
    this.#stored = new StoredValue(storage, "kouxing.choices");
    this.#values = { ...this.#stored.read() };
  }

  /** Return a preference, or null. */
  get(name) {
    return this.#values[name] ?? null;
  }

  set(name, value) {
    this.#values[name] = value;
    this.#stored.write(this.#values);
  }
}

/** The mouth profile of this browser's user, which the gateway learned. */
export class MouthProfileStore {
  current = null; // { profile (base64), learnedOn (ms since 1970), before, after } or null
  #stored;

  constructor(storage) {
    this.#stored = new StoredValue(storage, "kouxing.voice"); // browsers have used it from the start
    const stored = this.#stored.read();
    if (typeof stored?.profile === "string" && stored.profile !== "") {
      const { learntOn, learnedOn = learntOn, ...rest } = stored; // learntOn: the name in earlier versions
      this.current = { ...rest, learnedOn };
    }
  }

  /** Keep a profile; null deletes it. */
  keep(profile) {
    this.current = profile;
    this.#stored.write(profile);
  }
}
