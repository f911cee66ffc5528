// The browser's microphone, or a file in its place, as a session's audio.

import { socketUrl } from "./address.js";
import { capture, openCaptureContext } from "./capture.js";
import { fileSpeech } from "./file-speech.js";
import { say } from "./language.js";
import { Uplink } from "./uplink.js";

const RETRY_MS = 500;
const TAIL_MS = 1000; // of silence behind a file, for its last frames
const GIVE_UP_MS = 30000; // a crashed service is started again within this

export class Microphone {
  #handlers;
  #turn = null; // from one start to its stop
  #socket = null;
  #stream = null;
  #speech = null; // of a file
  #context = null;
  #uplink = null; // while it streams
  #retry = null; // timer
  #giveUpMs = null; // until when to try again, once it has streamed

  /**
   * @param handlers { mouthProfile(): the speaker's in base64, or "", lips(): the lip model to begin with,
   *   or null, state("off" | "starting" | "on" | "interrupted"), level(rms), session(name),
   *   error({ code, text }) }
   */
  constructor(handlers) {
    this.#handlers = handlers;
  }

  /** Whether it streams, or is to. */
  get active() {
    return this.#turn !== null;
  }

  /** Whether a file is spoken instead. */
  get isFile() {
    return this.#speech !== null;
  }

  /** How long ago media time m was spoken, ms; null if this is not our session. */
  ageMs(nowMs, mediaTime) {
    return this.#uplink?.ageMs(nowMs, mediaTime) ?? null;
  }

  /** Let another lip model move the mouth while the microphone streams. */
  chooseLips(name) {
    if (this.#uplink) this.#socket.send(JSON.stringify({ lips: name }));
  }

  start() {
    return this.#take(async (source) => {
      if (!navigator.mediaDevices) {
        throw {
          en: "A microphone needs https, or this page at http://localhost.",
          zh: "使用麦克风需要 https 或 localhost。",
        };
      }
      source.stream = await navigator.mediaDevices.getUserMedia({
        audio: { echoCancellation: true, autoGainControl: true, channelCount: 1 },
      });
      for (const track of source.stream.getTracks()) {
        track.onended = () =>
          this.#fail({ en: "The microphone was unplugged.", zh: "麦克风断开了。" });
      }
      source.context = await openCaptureContext();
    });
  }

  /** Speak a file, as if it were the microphone. */
  speak(file) {
    return this.#take(async (source) => {
      source.context = await openCaptureContext();
      source.speech = await fileSpeech(source.context, file);
      source.stream = source.speech.stream;
    });
  }

  /** Stream from what open(source) puts into a source, unless it is stopped meanwhile. */
  async #take(open) {
    this.#release();
    const turn = {};
    this.#turn = turn;
    this.#handlers.state("starting");
    const source = { stream: null, context: null, speech: null };
    let problem = null;
    try {
      await open(source);
    } catch (error) {
      problem = reason(error);
    }
    if (this.#turn !== turn || problem !== null) letGo(source);
    if (this.#turn !== turn) return;
    if (problem !== null) {
      this.#fail(problem);
      return;
    }
    ({ stream: this.#stream, context: this.#context, speech: this.#speech } = source);
    capture(this.#context, this.#stream, (chunk, rms, recordedMs) => {
      this.#handlers.level(rms);
      this.#uplink?.send(performance.now(), recordedMs, chunk);
    });
    this.#connect();
  }

  stop() {
    this.#release();
  }

  #connect() {
    const socket = new WebSocket(socketUrl("/microphone"));
    let refusal = null;
    this.#socket = socket;
    socket.onopen = () => {
      const { sampleRate } = this.#context;
      const hello = { sample_rate_hz: sampleRate, num_channels: 1, encoding: "s16le" };
      socket.send(JSON.stringify({ ...hello, voice: this.#handlers.mouthProfile() }));
    };
    socket.onmessage = (event) => {
      if (this.#socket !== socket) return;
      const message = JSON.parse(event.data);
      if (message.type === "opened") this.#begin(message.session);
      else if (this.#uplink !== null && message.type === "error") this.#handlers.error(message);
      else refusal = message;
    };
    socket.onclose = () => {
      if (this.#socket === socket) this.#onClose(refusal);
    };
  }

  #begin(session) {
    this.#uplink = new Uplink(this.#socket, this.#context.sampleRate);
    this.#giveUpMs = null;
    this.#handlers.session(session);
    this.#handlers.state("on");
    this.#speech?.play(() => setTimeout(() => this.#release(), TAIL_MS));
    const lips = this.#handlers.lips();
    if (lips !== null) this.chooseLips(lips);
  }

  /** Once it has streamed, it goes on by itself: a service, or the gateway, is started again. */
  #onClose(refusal) {
    if (this.#uplink !== null) {
      this.#uplink = null;
      this.#giveUpMs = performance.now() + GIVE_UP_MS;
      this.#handlers.state("interrupted");
    }
    if (this.#giveUpMs !== null && performance.now() < this.#giveUpMs) {
      this.#retry = setTimeout(() => this.#connect(), RETRY_MS);
    } else if (refusal?.code) {
      this.#handlers.error(refusal);
      this.#release();
    } else {
      this.#fail({
        en: "The microphone stopped: the gateway takes none now. Press Microphone to try again.",
        zh: "麦克风已停止：网关暂不接受。请再按“麦克风”重试。",
      });
    }
  }

  #fail(texts) {
    this.#handlers.error({ code: "microphone", text: say(texts) });
    this.#release();
  }

  #release() {
    const socket = this.#socket;
    clearTimeout(this.#retry);
    letGo({ stream: this.#stream, context: this.#context });
    this.#socket = this.#stream = this.#speech = this.#context = this.#uplink = this.#giveUpMs = null;
    this.#turn = null;
    socket?.close();
    this.#handlers.level(0);
    this.#handlers.state("off");
  }
}

/** Return why there is no sound, { en, zh }, of what was thrown. */
function reason(error) {
  if (error.zh) return error;
  if (error.name === "NotAllowedError") {
    return { en: "The microphone was not allowed.", zh: "未允许使用麦克风。" };
  }
  return { en: `No microphone: ${error.message}`, zh: `没有麦克风：${error.message}` };
}

function letGo({ stream, context }) {
  for (const track of stream?.getTracks() ?? []) track.stop();
  context?.close();
}
