// The state that the gateway reports: the connection, the session that is shown, missing services.

export class GatewayState {
  isConnected = false;
  wasConnected = false;
  session = null; // name of the session that is shown
  epoch = 0; // of the session; it increases with each restart
  isSample = false; // whether the session is the sample sentence that this page asked for
  lips = null; // lip model of the session; null: unknown
  missing = []; // services that are not running

  /** Whether the gateway refused the first connection, although it served this page. */
  isRefused = false;

  setConnected(isConnected) {
    this.isConnected = isConnected;
    this.wasConnected ||= isConnected;
    this.isRefused = !this.wasConnected;
    if (!isConnected) this.session = null;
  }

  /** Take a "session" message; return { isRestart, isOther }: whether the epoch or session changed. */
  setSession({ session, epoch, sample, lips }) {
    const isOther = session !== this.session;
    const isRestart = !isOther && session !== null && epoch > this.epoch;
    this.session = session;
    this.epoch = epoch;
    this.isSample = sample;
    if (session !== null) this.lips = lips || null; // a session that has ended is still visible
    return { isOther, isRestart };
  }
}
