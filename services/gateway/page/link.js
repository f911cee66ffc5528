// The WebSocket to the gateway that brings everything to be seen and heard; proto/GATEWAY.md.

import { socketUrl } from "./address.js";
import { readMessage } from "./messages.js";

const RETRY_MS = [300, 5000];

/** Connects, and connects again by itself for as long as the page is open. */
export class Link {
  #handlers;
  #chosen;
  #socket = null;
  #retryMs = RETRY_MS[0];

  /**
   * @param {string} chosen session to look at; "" for the newest
   * @param handlers { state(connected), fap(mediaTime, values), sound(mediaTime, samples),
   *   rest(values), text(object) }
   */
  constructor(chosen, handlers) {
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

  #connect() {
    const socket = new WebSocket(socketUrl("/viewer", { session: this.#chosen }));
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.#retryMs = RETRY_MS[0];
      this.#handlers.state(true);
    };
    socket.onmessage = (event) => this.#receive(event.data);
    socket.onclose = () => {
      this.#handlers.state(false);
      setTimeout(() => this.#connect(), this.#retryMs);
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
  }
}
