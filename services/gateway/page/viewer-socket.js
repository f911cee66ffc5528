// The WebSocket that brings a session's frames, sound and events; see proto/GATEWAY.md.

import { readMessage } from "./messages.js";

const RETRY_MS = { min: 300, max: 5000 };

/** Connects, and reconnects by itself until it is closed. */
export class ViewerSocket {
  #address;
  #handlers;
  #chosen;
  #socket = null;
  #retryTimer = null;
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

  /** Send a command if the socket is open. */
  send(command) {
    if (this.#socket?.readyState === WebSocket.OPEN) this.#socket.send(JSON.stringify(command));
  }

  /** Disconnect and stop reconnecting. */
  close() {
    clearTimeout(this.#retryTimer);
    this.#socket.onclose = this.#socket.onerror = null;
    this.#socket.close();
    this.#handlers.state(false);
  }

  #connect() {
    const chosen = this.#chosen;
    const socket = new WebSocket(this.#address(chosen));
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.#retryMs = RETRY_MS.min;
      this.#handlers.state(true);
      if (this.#chosen !== chosen) this.follow(this.#chosen); // chosen while it was connecting
    };
    socket.onmessage = (event) => this.#receive(event.data);
    // Node 22 reports a failed connection only as an error.
    socket.onclose = socket.onerror = () => {
      socket.onclose = socket.onerror = null;
      this.#handlers.state(false);
      this.#retryTimer = setTimeout(() => this.#connect(), this.#retryMs);
      this.#retryMs = Math.min(RETRY_MS.max, this.#retryMs * 2);
    };
    this.#socket = socket;
  }

  #receive(data) {
    if (typeof data === "string") {
      this.#handlers.text(JSON.parse(data));
      return;
    }
    const message = readMessage(data);
    if (message?.faps) this.#handlers.fap(message.mediaTime, message.faps);
    else if (message?.samples) this.#handlers.sound(message.mediaTime, message.samples);
    else if (message?.rest) this.#handlers.rest(message.rest);
    else if (message?.weights) this.#handlers.weights(message.mediaTime, message.weights);
    else if (message?.restWeights) this.#handlers.restWeights(message.restWeights);
  }
}
