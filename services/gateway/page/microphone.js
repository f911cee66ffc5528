// The browser's microphone as a session's audio.

import { capture, openCaptureContext } from "./capture.js";
import { socketUrl } from "./link.js";
import { Uplink } from "./uplink.js";

export class Microphone {
  #handlers;
  #socket = null;
  #stream = null;
  #context = null;
  #uplink = null; // while it streams

  /**
   * @param handlers { voice(): the speaker's in base64, or "", lips(): the lip model to begin with,
   *   or null, state("off" | "starting" | "on"), level(rms), session(name), error({ code, text }) }
   */
  constructor(handlers) {
    this.#handlers = handlers;
  }

  get active() {
    return this.#socket !== null || this.#stream !== null;
  }

  /** How long ago media time m was spoken, ms; null if this is not our session. */
  ageMs(nowMs, mediaTime) {
    return this.#uplink?.ageMs(nowMs, mediaTime) ?? null;
  }

  /** Let another lip model move the mouth while the microphone streams. */
  chooseLips(name) {
    if (this.#uplink) this.#socket.send(JSON.stringify({ lips: name }));
  }

  async start() {
    this.#handlers.state("starting");
    if (!navigator.mediaDevices) {
      this.#fail("a microphone needs https, or this page at http://localhost");
      return;
    }
    try {
      this.#stream = await navigator.mediaDevices.getUserMedia({
        audio: { echoCancellation: true, autoGainControl: true, channelCount: 1 },
      });
      this.#context = await openCaptureContext();
    } catch (error) {
      const isDenied = error.name === "NotAllowedError";
      const denied = "the microphone was not allowed 未允许使用麦克风";
      this.#fail(isDenied ? denied : `no microphone: ${error.message}`);
      return;
    }
    this.#connect();
  }

  stop() {
    this.#socket?.close();
    this.#release();
  }

  #connect() {
    const context = this.#context;
    const socket = new WebSocket(socketUrl("/microphone"));
    let isAnswered = false;
    this.#socket = socket;
    socket.onopen = () => {
      const hello = { sample_rate_hz: context.sampleRate, num_channels: 1, encoding: "s16le" };
      socket.send(JSON.stringify({ ...hello, voice: this.#handlers.voice() }));
    };
    socket.onmessage = (event) => {
      const message = JSON.parse(event.data);
      isAnswered = true;
      if (message.type === "opened") this.#capture(socket, message.session);
      else this.#handlers.error(message);
    };
    socket.onclose = () => {
      if (this.#socket !== socket) return;
      if (isAnswered) this.#release();
      else this.#fail("the gateway takes no microphone now");
    };
  }

  #capture(socket, session) {
    if (this.#socket !== socket) return;
    this.#handlers.session(session);
    this.#handlers.state("on");
    const uplink = new Uplink(socket, this.#context.sampleRate);
    this.#uplink = uplink;
    const lips = this.#handlers.lips();
    if (lips !== null) this.chooseLips(lips);
    capture(this.#context, this.#stream, (chunk, rms, recordedMs) => {
      this.#handlers.level(rms);
      uplink.send(performance.now(), recordedMs, chunk);
    });
  }

  #fail(text) {
    this.#handlers.error({ type: "error", code: "microphone", text });
    this.#release();
  }

  #release() {
    for (const track of this.#stream?.getTracks() ?? []) track.stop();
    this.#context?.close();
    this.#socket = this.#stream = this.#context = this.#uplink = null;
    this.#handlers.level(0);
    this.#handlers.state("off");
  }
}
