// Speech into a new session.

import { socketUrl } from "./address.js";

const PIECE_BYTES = 32000; // of one message
const MAX_BUFFERED_BYTES = 1 << 18; // then whoever pushes waits
const LOOK_EVERY_MS = 10;

/** A session of its own: audio goes in. */
export class Speaker {
  #socket;
  #encoding;
  #failure = null;
  #isOver = null; // a promise

  /** Use Speaker.open. */
  constructor(socket, session, encoding, closed) {
    this.#socket = socket;
    this.#encoding = encoding;
    this.session = session;
    socket.onmessage = ({ data }) => {
      const { type, text } = JSON.parse(data);
      if (type === "error" || type === "closed") this.#failure = new Error(text);
    };
    this.#isOver = new Promise((fulfil) => {
      socket.onclose = () => {
        closed(this.#failure);
        fulfil();
      };
    });
  }

  /**
   * Open a session.
   *
   * @param gateway address of the gateway
   * @param options { sampleRateHz, numChannels, encoding: "s16le" or "f32le", ahead: audio may come
   *   before its time, voice: in base64, token, closed: called when the session is over, with an error
   *   or null }
   * @returns a promise of a speaker; it fails if the gateway refuses
   */
  static open(gateway, options = {}) {
    const { sampleRateHz = 16000, numChannels = 1, encoding = "s16le", token = "" } = options;
    const { ahead = false, voice, closed = () => {} } = options;
    const format = { sample_rate_hz: sampleRateHz, num_channels: numChannels, encoding };
    const socket = new WebSocket(socketUrl(gateway, "/microphone", { token }));
    return new Promise((resolve, reject) => {
      socket.onopen = () => socket.send(JSON.stringify({ ...format, ahead, voice }));
      socket.onmessage = ({ data }) => {
        const { type, session, text } = JSON.parse(data);
        if (type === "opened") resolve(new Speaker(socket, session, encoding, closed));
        else reject(new Error(text));
      };
      socket.onclose = () => reject(new Error(`${gateway} cannot be reached`));
    });
  }

  /**
   * Send audio; wait for the promise before more, where more comes than is spoken.
   *
   * @param audio interleaved: Int16Array, Float32Array within ±1, or bytes of PCM in the session's
   *   encoding
   */
  async push(audio) {
    const pcm = toPcm(audio, this.#encoding);
    for (let begin = 0; begin < pcm.byteLength; begin += PIECE_BYTES) {
      this.#check();
      this.#socket.send(pcm.subarray(begin, begin + PIECE_BYTES));
      while (this.#socket.bufferedAmount > MAX_BUFFERED_BYTES && this.#socket.readyState === WebSocket.OPEN) {
        await new Promise((done) => setTimeout(done, LOOK_EVERY_MS));
      }
    }
  }

  /** Interrupt: audio not yet shown is dropped, and the face returns to rest. */
  flush() {
    this.#check();
    this.#socket.send(JSON.stringify({ flush: true }));
  }

  /** Say that no more audio comes; the promise is fulfilled when all is spoken and the session closed. */
  async finish() {
    this.#check();
    this.#socket.send(JSON.stringify({ eof: 1 }));
    await this.#isOver;
  }

  /** Close the session at once. */
  close() {
    this.#socket.close();
  }

  #check() {
    if (this.#failure) throw this.#failure;
    if (this.#socket.readyState !== WebSocket.OPEN) throw new Error("the session is over");
  }
}

function toPcm(audio, encoding) {
  if (encoding === "s16le" && audio instanceof Float32Array) {
    audio = Int16Array.from(audio, (value) => Math.round(32767 * Math.max(-1, Math.min(1, value))));
  } else if (encoding === "f32le" && audio instanceof Int16Array) {
    audio = Float32Array.from(audio, (value) => value / 32767);
  }
  return ArrayBuffer.isView(audio)
    ? new Uint8Array(audio.buffer, audio.byteOffset, audio.byteLength)
    : new Uint8Array(audio);
}
