// What comes from a session; proto/GATEWAY.md has all messages.

import { socketUrl } from "./address.js";
import { Link } from "./page/link.js";

const TEXTS = ["session", "phone", "syllable", "speech", "end", "error", "status", "lips"];

/** Follows a session, or always the newest; connects again by itself until it is closed. */
export class Viewer {
  #link;

  /**
   * @param gateway address of the gateway
   * @param handlers functions by what they take; index.d.ts has all
   * @param options { session: name, "" for the newest; shapes: set that comes beside FAP frames;
   *   token: the gateway's }
   */
  constructor(gateway, handlers, { session = "", shapes = "", token = "" } = {}) {
    let names = [];
    let ready = null;
    /** Fulfilled when a session is shown: nothing that is said from then on is missed. */
    this.ready = new Promise((fulfil) => (ready = fulfil));
    const tell = (name, ...values) => handlers[name]?.(...values);
    this.#link = new Link((chosen) => socketUrl(gateway, "/viewer", { session: chosen, shapes, token }), session, {
      state: (isConnected) => tell("connected", isConnected),
      fap: (mediaTime, values) => tell("frame", mediaTime, values),
      sound: (mediaTime, samples) => tell("sound", mediaTime, samples),
      rest: (values) => tell("rest", values),
      weights: (mediaTime, weights) => tell("weights", mediaTime, weights, names),
      restWeights: (weights) => tell("restWeights", weights, names),
      text(message) {
        if (message.type === "shapes") ({ names } = message);
        else if (TEXTS.includes(message.type)) tell(message.type, message);
        if (message.type === "session" && message.session !== null) ready();
      },
    });
  }

  /** Look at another session; "" for the newest. */
  follow(session) {
    this.#link.follow(session);
  }

  /** Send a command, such as { express: { joy: 0.5 } }. */
  send(command) {
    this.#link.send(command);
  }

  close() {
    this.#link.close();
  }
}
