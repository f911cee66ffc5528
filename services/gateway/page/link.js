// The WebSocket to the gateway that brings everything to be seen and heard; proto/GATEWAY.md.

import { readMessage } from "./messages.js";

const RETRY_MS = [300, 5000];

/** Connects, and connects again by itself until it is closed. */
export class Link {
  #address;
  #handlers;
  #chosen;
  #socket = null;
  #retry = null;
  #retryMs = RETRY_MS[0];

  /**
   * @param address gives the WebSocket's address for a session
   * @param {string} chosen session to look at; "" for the newest
   * @param handlers { state(connected), fap(mediaTime, values), sound(mediaTime, samples),
   *   rest(values), text(object) }; where the address asks for shapes, also weights(mediaTime, values)
   *   and restWeights(values)
   */
  constructor(address, chosen, handlers) {
    this.#address = address;
    this.#chosen = chosen;
    this.#handlers = handlers;
    this.#connect();
  }

  /** Look at another session; "" for the newest. */
  follow(session) {
    this.#chosen = session;
    this.send({ follow: session });
  }

  /** Send a command, unless there is no connection. */
  send(command) {
    if (this.#socket?.readyState === WebSocket.OPEN) this.#socket.send(JSON.stringify(command));
  }

  /** Disconnect for good. */
  close() {
    clearTimeout(this.#retry);
    this.#socket.onclose = null;
    this.#socket.close();
    this.#handlers.state(false);
  }

  #connect() {
    const socket = new WebSocket(this.#address(this.#chosen));
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.#retryMs = RETRY_MS[0];
      this.#handlers.state(true);
    };
    socket.onmessage = (event) => this.#receive(event.data);
    socket.onclose = () => {
      this.#handlers.state(false);
      this.#retry = setTimeout(() => this.#connect(), this.#retryMs);
      this.#retryMs = Math.min(RETRY_MS[1], this.#retryMs * 2);
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
