// The browser's microphone as a session's audio.

import { socketUrl } from "./link.js";
import { Uplink } from "./uplink.js";

const MAX_RATE_HZ = 48000;

export class Microphone {
  #handlers;
  #socket = null;
  #stream = null;
  #context = null;
  #uplink = null; // while it streams
  #lips = null; // the lip model that was chosen

  /**
   * @param handlers { state("off" | "starting" | "on"), level(rms), session(name),
   *   error({ text }) }
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

  /** Let another lip model move the mouth, now and in later sessions. */
  chooseLips(name) {
    this.#lips = name;
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
      this.#context = new AudioContext({ latencyHint: "interactive" });
      if (this.#context.sampleRate > MAX_RATE_HZ) {
        this.#context.close();
        this.#context = new AudioContext({ latencyHint: "interactive", sampleRate: MAX_RATE_HZ });
      }
      await this.#context.audioWorklet.addModule("microphone-worklet.js");
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
      socket.send(JSON.stringify(hello));
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
    const node = new AudioWorkletNode(this.#context, "capture", {
      numberOfOutputs: 0,
      channelCount: 1,
      channelCountMode: "explicit",
    });
    const uplink = new Uplink(socket, this.#context.sampleRate);
    this.#uplink = uplink;
    if (this.#lips !== null) this.chooseLips(this.#lips);
    node.port.onmessage = ({ data: { chunk, rms } }) => {
      this.#handlers.level(rms);
      uplink.send(performance.now(), chunk);
    };
    this.#context.createMediaStreamSource(this.#stream).connect(node);
    this.#context.resume();
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
