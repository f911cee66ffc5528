// The state of the gateway, from its messages.

/** The state that the gateway reports: the connection, the session that is shown, missing services. */
export class GatewayState {
  isConnected = false;
  wasConnected = false;
  session = null; // name of the session that is shown
  epoch = 0; // epoch of the session; it increases with each restart
  isSample = false; // whether the session is the sample sentence that this page asked for
  lipModel = null; // lip model of the session; null: unknown
  language = ""; // of the session; "": unknown
  acoustic = ""; // acoustic model of the session: full or light
  missing = []; // services that are not running

  /** Whether the gateway rejected the connection, although it runs: the first one, or because of the token. */
  isRejected = false;

  /** Whether the page is connecting for the first time. */
  get isStarting() {
    return !this.wasConnected && !this.isRejected;
  }

  setConnected(isConnected) {
    this.isConnected = isConnected;
    this.wasConnected ||= isConnected;
    if (isConnected) this.isRejected = false;
    else this.isRejected ||= !this.wasConnected;
    if (!isConnected) this.session = null;
  }

  /** Process a "session" message; return { isRestart, isOther }: whether the epoch or session changed. */
  setSession({ session, epoch, sample, lip_model, language, acoustic }) {
    // A session whose epoch is lower is a new one with the name of an earlier one.
    const isOther = session !== this.session || epoch < this.epoch;
    const isRestart = !isOther && session !== null && epoch > this.epoch;
    this.session = session;
    this.epoch = epoch;
    this.isSample = sample;
    this.language = language;
    this.acoustic = acoustic;
    if (session !== null) this.lipModel = lip_model || null; // a session that has ended is still visible
    return { isOther, isRestart };
  }
}
