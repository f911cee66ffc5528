// The browser's microphone as a session's audio.

import { socketUrl } from "./link.js";

const MAX_RATE_HZ = 48000;
const MAX_BUFFERED_BYTES = 1 << 18; // a network slower than speech must not be felt for ever

export class Microphone {
  #handlers;
  #socket = null;
  #stream = null;
  #context = null;
  #firstMs = null; // page's clock at media time 0

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
    return this.#firstMs === null ? null : nowMs - this.#firstMs - mediaTime / 16;
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
    let numSent = 0;
    node.port.onmessage = ({ data: { chunk, rms } }) => {
      this.#handlers.level(rms);
      if (socket.readyState !== WebSocket.OPEN) return;
      if (socket.bufferedAmount > MAX_BUFFERED_BYTES) {
        this.#firstMs = null; // what is left out here moves media time
        return;
      }
      socket.send(chunk.buffer);
      numSent += chunk.length;
      // The least difference seen is the truest: a chunk can be handed over late, never early.
      const firstMs = performance.now() - (1000 * numSent) / this.#context.sampleRate;
      this.#firstMs = Math.min(this.#firstMs ?? Infinity, firstMs);
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
    this.#socket = this.#stream = this.#context = this.#firstMs = null;
    this.#handlers.level(0);
    this.#handlers.state("off");
  }
}
