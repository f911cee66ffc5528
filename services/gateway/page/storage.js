// Stores the user's choices for the next visit. The browser's localStorage is injected as a function; it
// throws if the browser forbids it.

const PREFERENCES = "kouxing.choices";
const MOUTH_PROFILE = "kouxing.voice"; // an old name, under which browsers already store profiles

function read(storage, key) {
  try {
    return JSON.parse(storage().getItem(key));
  } catch {
    return null; // not written by this page
  }
}

/** Store a value; null deletes it. If nothing can be stored, the value lasts until the page closes. */
function write(storage, key, value) {
  try {
    if (value === null) storage().removeItem(key);
    else storage().setItem(key, JSON.stringify(value));
  } catch {
    // the storage is full or forbidden
  }
}

/** The user's preferences. */
export class Preferences {
  #storage;
  #values;

  constructor(storage) {
    this.#storage = storage;
    this.#values = { ...read(storage, PREFERENCES) };
  }

  /** Return a preference, or null. */
  get(name) {
    return this.#values[name] ?? null;
  }

  set(name, value) {
    this.#values[name] = value;
    write(this.#storage, PREFERENCES, this.#values);
  }
}

/** The mouth profile of this browser's user, which the gateway learned. */
export class MouthProfileStore {
  current = null; // { profile (base64), learnedOn (ms since 1970), before, after } or null
  #storage;

  constructor(storage) {
    this.#storage = storage;
    const stored = read(storage, MOUTH_PROFILE);
    if (typeof stored?.profile === "string" && stored.profile !== "") {
      const { learntOn, learnedOn = learntOn, ...rest } = stored; // learntOn: the name in earlier versions
      this.current = { ...rest, learnedOn };
    }
  }

  /** Keep a profile; null deletes it. */
  keep(profile) {
    this.current = profile;
    write(this.#storage, MOUTH_PROFILE, profile);
  }
}
