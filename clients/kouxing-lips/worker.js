// Runs the engine in a worker. It receives sound and sends faces.

import { LipEngine } from "./engine/engine.js";
import { loadModel } from "./engine/model.js";

let model = null;
let engine = null; // the engine of the newest session
let port = null; // port of the audio thread

self.onmessage = async ({ data: { type, ...data } }) => {
  try {
    if (NEED_SESSION.includes(type) && !engine) throw new Error("no sound is open; call open() or listenTo() first");
    await HANDLERS[type](data);
  } catch (error) {
    self.postMessage({ type: "error", request: type, session: data.session, text: error.message });
  }
};

const NEED_SESSION = ["push", "finish", "express"];
const HANDLERS = {
  /** Load the models. */
  async load({ models, phones }) {
    model = await loadModel(models, { phones });
    self.postMessage({ type: "loaded" });
  },

  /** Start a session; its sound arrives over a port, or by "push". */
  open({ session, options, input }) {
    port?.close();
    engine = new LipEngine(model, options);
    self.postMessage({ type: "opened", session, names: engine.names });
    port = input ?? null;
    if (port === null) return;
    const current = engine;
    port.onmessage = ({ data: { samples, endS } }) => {
      if (engine !== current) return;
      try {
        send(session, current.push(samples), endS - current.inputS);
      } catch (error) {
        input.close(); // one report is enough
        self.postMessage({ type: "error", request: "sound", session, text: error.message });
      }
    };
  },

  push({ session, samples }) {
    send(session, engine.push(samples));
  },

  finish({ session }) {
    port?.close();
    send(session, engine.finish());
    engine = null;
    self.postMessage({ type: "finished", session });
  },

  express({ strengths, holdS }) {
    engine.express(strengths, holdS);
  },
};

/** Send frames to the page; startS is the start of the session on the clock of the audio thread. */
function send(session, frames, startS = null) {
  const phones = engine.newPhones;
  if (frames.length || phones.length) self.postMessage({ type: "frames", session, frames, phones, startS });
}
