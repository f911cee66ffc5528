// The WebSocket that brings a session's frames, sound and events; see proto/GATEWAY.md.

const RETRY_MS = { min: 300, max: 5000 };
const TICK_MS = 1000;
// Faces arrive continuously, even at rest. If none arrives, the network is down, which the socket reports only after
// minutes. Ticks are counted instead of time, because a busy or previously frozen page receives messages late.
const MAX_SILENT_TICKS = 5;
const [FAPS, SOUND, REST, SHAPES, REST_SHAPES] = [1, 2, 3, 4, 5]; // types of binary messages
const HEADER_BYTES = 16;

/** Connects, and reconnects by itself until it is closed. */
export class ViewerSocket {
  #address;
  #handlers;
  #chosen;
  #socket = null; // null after close()
  #unsent = []; // commands that wait until the socket has connected
  #retryTimer = null;
  #tickTimer = null;
  #retryMs = RETRY_MS.min;

  /**
   * @param address function that returns the WebSocket's URL for a session
   * @param {string} chosen session to show; "" for the newest
   * @param handlers { state(connected), fap(mediaTime, values), sound(mediaTime, samples),
   *   rest(values), text(object) }; if the URL asks for shapes, also weights(mediaTime, values)
   *   and restWeights(values)
   */
  constructor(address, chosen, handlers) {
    this.#address = address;
    this.#chosen = chosen;
    this.#handlers = handlers;
    this.#connect();
  }

  /** Show another session; "" for the newest. */
  follow(session) {
    this.#chosen = session;
    this.send({ follow: session });
  }

  /** Send a command. It waits while the socket is connecting, and is dropped if that fails. */
  send(command) {
    const state = this.#socket?.readyState;
    if (state === WebSocket.OPEN) this.#socket.send(JSON.stringify(command));
    else if (state === WebSocket.CONNECTING) this.#unsent.push(command);
  }

  /** Disconnect and stop reconnecting. */
  close() {
    const socket = this.#socket;
    if (socket === null) return;
    this.#socket = null;
    clearTimeout(this.#retryTimer);
    this.#abandon(socket);
    this.#handlers.state(false);
  }

  #abandon(socket) {
    clearInterval(this.#tickTimer);
    socket.onopen = socket.onmessage = socket.onclose = socket.onerror = null;
    socket.close();
  }

  #connect() {
    const socket = new WebSocket(this.#address(this.#chosen));
    socket.binaryType = "arraybuffer";
    this.#unsent = [];
    socket.onopen = () => {
      this.#retryMs = RETRY_MS.min;
      for (const command of this.#unsent) this.send(command);
      this.#handlers.state(true);
    };
    let numSilentTicks = 0;
    socket.onmessage = (event) => {
      numSilentTicks = 0;
      this.#receive(event.data);
    };
    const reconnect = () => {
      this.#abandon(socket);
      this.#retryTimer = setTimeout(() => this.#connect(), this.#retryMs);
      this.#retryMs = Math.min(RETRY_MS.max, this.#retryMs * 2);
      this.#handlers.state(false); // may call close()
    };
    // Node 22 reports a failed connection only as an error.
    socket.onclose = socket.onerror = reconnect;
    this.#tickTimer = setInterval(() => {
      numSilentTicks++;
      if (numSilentTicks > MAX_SILENT_TICKS) reconnect();
    }, TICK_MS);
    this.#socket = socket;
  }

  #receive(data) {
    if (typeof data === "string") {
      this.#handlers.text(JSON.parse(data));
      return;
    }
    const header = new DataView(data);
    const [type, mediaTime] = [header.getUint8(0), header.getFloat64(8, true)];
    const valuesOf = (Type) => new Type(data, HEADER_BYTES);
    if (type === FAPS) this.#handlers.fap(mediaTime, valuesOf(Float32Array));
    else if (type === SOUND) this.#handlers.sound(mediaTime, valuesOf(Int16Array));
    else if (type === REST) this.#handlers.rest(valuesOf(Float32Array));
    else if (type === SHAPES) this.#handlers.weights(mediaTime, valuesOf(Float32Array));
    else if (type === REST_SHAPES) this.#handlers.restWeights(valuesOf(Float32Array));
  }
}
