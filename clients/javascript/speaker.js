// Sends speech into a new session.

import { checkOptions, checkWebSocket, socketUrl } from "./viewer.js";

const OPTIONS = [
  "sampleRateHz", "numChannels", "encoding", "ahead", "mouthProfile", "language", "token", "error", "closed",
];
const AUDIO_TYPES = ["Int16Array", "Float32Array", "Uint8Array", "ArrayBuffer", "DataView"];
const FULL_SCALE = 32768; // as in the services
const MAX_FLOAT = 8; // smaller values beyond 1 are clipped

const MESSAGE_BYTES = 32000;
const MAX_BUFFERED_BYTES = 1 << 18; // above it, push() waits
const POLL_MS = 10;
const POLICY_VIOLATION = 1008; // the last error has ended the session
const NORMAL_CODES = [1000, 1005];

/** A session that this program feeds with audio. */
export class Speaker {
  #socket;
  #encoding;
  #failure = null;
  #isClosing = false;
  #closed; // a promise

  /** Use Speaker.open instead. */
  constructor(socket, session, encoding, onError, onClosed) {
    this.#socket = socket;
    this.#encoding = encoding;
    this.session = session;
    let lastError = null;
    socket.onmessage = ({ data }) => {
      const { type, text } = JSON.parse(data);
      if (type === "closed") this.#failure = new Error(text);
      if (type === "error") onError((lastError = new Error(text)));
    };
    this.#closed = new Promise((resolve) => {
      socket.onclose = ({ code, reason }) => {
        if (code === POLICY_VIOLATION) {
          this.#failure = lastError ?? new Error(reason || "the gateway has ended the session; open a new one");
        } else if (!this.#isClosing && !NORMAL_CODES.includes(code)) {
          this.#failure ??= new Error(reason || "the connection to the gateway is lost; open another session");
        }
        onClosed(this.#failure);
        resolve();
      };
    });
  }

  /**
   * Open a session.
   *
   * @param gateway address of the gateway
   * @param options { sampleRateHz, numChannels, encoding: "s16le" or "f32le", ahead: whether audio may
   *   come faster than real time, mouthProfile: in base64, language, token, error: called with each
   *   error, after which the session may continue, closed: called with an error or null when the
   *   session has ended }
   * @returns a promise of a Speaker; it is rejected if the gateway is not running or rejects the session
   */
  static async open(gateway, options = {}) {
    const {
      sampleRateHz = 16000, numChannels = 1, encoding = "s16le", token = "",
      ahead = false, mouthProfile, language, error = () => {}, closed = () => {}, ...unknown
    } = options;
    checkOptions(unknown, OPTIONS);
    const format = { sample_rate_hz: sampleRateHz, num_channels: numChannels, encoding };
    checkWebSocket();
    const socket = new WebSocket(socketUrl(gateway, "/microphone", { token }));
    return new Promise((resolve, reject) => {
      socket.onopen = () => socket.send(JSON.stringify({ ...format, ahead, mouth_profile: mouthProfile, language }));
      socket.onmessage = ({ data }) => {
        const { type, session, text } = JSON.parse(data);
        if (type === "opened") resolve(new Speaker(socket, session, encoding, error, closed));
        else reject(new Error(text));
      };
      // Node 22 reports a failed connection only as an error. A WebSocket does not give the reason.
      socket.onerror = socket.onclose = () => {
        reject(
          new Error(
            `cannot connect to the gateway at ${gateway}. Start it with: kouxing run. If it is running, it rejects` +
              " the token, the page's origin (gateway.trusted_origins), or more microphones",
          ),
        );
      };
    });
  }

  /**
   * Send audio. If it arrives faster than real time, wait for the promise before the next call.
   *
   * @param audio interleaved: Int16Array, Float32Array from -1 to 1, or bytes of PCM in the session's
   *   encoding
   */
  async push(audio) {
    const pcm = toPcm(audio, this.#encoding);
    for (let begin = 0; begin < pcm.byteLength; begin += MESSAGE_BYTES) {
      this.#checkOpen();
      this.#socket.send(pcm.subarray(begin, begin + MESSAGE_BYTES));
      while (this.#isOpen && this.#socket.bufferedAmount > MAX_BUFFERED_BYTES) {
        await new Promise((resolve) => setTimeout(resolve, POLL_MS));
      }
    }
  }

  /** Interrupt: drop audio whose face is not shown yet. The face returns to rest. */
  flush() {
    this.#checkOpen();
    this.#socket.send(JSON.stringify({ flush: true }));
  }

  /**
   * End the audio. The promise is resolved when all is spoken and the session is closed; it is rejected
   * if an error ends the session first.
   */
  async finish() {
    this.#checkOpen();
    this.#socket.send(JSON.stringify({ last: true }));
    await this.#closed;
    if (this.#failure) throw this.#failure;
  }

  /** Close the session immediately. */
  close() {
    this.#isClosing = true;
    this.#socket.close();
  }

  get #isOpen() {
    return this.#socket.readyState === WebSocket.OPEN;
  }

  #checkOpen() {
    if (this.#failure) throw this.#failure;
    if (!this.#isOpen) throw new Error("the session has ended; open a new one");
  }
}

function toPcm(audio, encoding) {
  // instanceof would not know the types of an iframe.
  const type = Object.prototype.toString.call(audio).slice("[object ".length, -1);
  if (!AUDIO_TYPES.includes(type)) {
    throw new TypeError(`audio must be an Int16Array, a Float32Array or bytes, not ${type}`);
  }
  if (type === "Float32Array" && !audio.every((value) => Math.abs(value) <= MAX_FLOAT)) {
    throw new RangeError("samples of a Float32Array must be from -1 to 1; divide integers by 32768");
  }
  if (encoding === "s16le" && type === "Float32Array") {
    audio = Int16Array.from(audio, (value) => Math.max(-FULL_SCALE, Math.min(FULL_SCALE - 1, Math.round(FULL_SCALE * value))));
  } else if (encoding === "f32le" && type === "Int16Array") {
    audio = Float32Array.from(audio, (value) => value / FULL_SCALE);
  }
  return ArrayBuffer.isView(audio)
    ? new Uint8Array(audio.buffer, audio.byteOffset, audio.byteLength)
    : new Uint8Array(audio);
}
