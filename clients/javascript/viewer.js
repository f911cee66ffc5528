// Receives the frames, sound and events of a session; see proto/GATEWAY.md.

import { ViewerSocket } from "./page/viewer-socket.js";

const SHAPE_SETS = ["arkit", "oculus", "vrm"];
const EVENTS = [
  "session", "phone", "syllable", "speech", "end", "error", "status", "face", "acoustic",
];

/**
 * Return the URL of one of the gateway's WebSockets.
 *
 * @param gateway address of the gateway, such as "http://localhost:8080"
 * @param path "/viewer" or "/microphone"
 * @param fields of the query, without empty fields
 */
export function socketUrl(gateway, path, fields) {
  if (!/^(http|ws)s?:/i.test(gateway)) {
    throw new TypeError(`${gateway} is not the address of a gateway, such as http://localhost:8080`);
  }
  const url = new URL(path, gateway);
  url.protocol = url.protocol.replace("http", "ws");
  for (const [name, value] of Object.entries(fields)) if (value) url.searchParams.set(name, value);
  return url.href;
}

/** Throw an error if the program has no WebSockets. */
export function checkWebSocket() {
  if (typeof WebSocket === "undefined") {
    throw new Error("kouxing-client needs Node 22 or newer, or a global WebSocket");
  }
}

/** Throw an error if there are options that a function does not have. */
export function checkOptions(unknown, known) {
  const [name] = Object.keys(unknown);
  if (name !== undefined) throw new TypeError(`unknown option ${name}; use ${known.join(", ")}`);
}

/** Follows one session, or always the newest. Reconnects by itself until it is closed. */
export class Viewer extends ViewerSocket {
  /**
   * @param gateway address of the gateway
   * @param handlers functions by name, see index.d.ts
   * @param options { session: name, "" for the newest; shapes: set of blendshapes to receive in
   *   addition to FAP frames; token: the gateway's token }
   */
  constructor(gateway, handlers, { session = "", shapes = "", token = "", ...unknown } = {}) {
    checkWebSocket();
    checkOptions(unknown, ["session", "shapes", "token"]);
    if (shapes && !SHAPE_SETS.includes(shapes)) {
      throw new TypeError(`unknown set of shapes ${shapes}; use ${SHAPE_SETS.join(", ")}`);
    }
    let names = [];
    let resolveReady = null;
    const call = (name, ...values) => handlers[name]?.(...values);
    const url = (chosen) => socketUrl(gateway, "/viewer", { session: chosen, shapes, token });
    super(url, session, {
      state: (isConnected) => call("connected", isConnected),
      fap: (mediaTime, values) => call("frame", mediaTime, values),
      sound: (mediaTime, samples) => call("sound", mediaTime, samples),
      rest: (values) => call("rest", values),
      weights: (mediaTime, weights) => call("weights", mediaTime, weights, names),
      restWeights: (weights) => call("restWeights", weights, names),
      text(message) {
        if (message.type === "shapes") ({ names } = message);
        else if (EVENTS.includes(message.type)) call(message.type, message);
        if (message.type === "session" && message.session !== null) resolveReady();
      },
    });
    /** Resolved when a session is shown. The viewer misses nothing from then on. */
    this.ready = new Promise((resolve) => (resolveReady = resolve));
  }
}
