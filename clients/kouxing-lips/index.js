// Lip sync in a page, from microphone, media or PCM to faces. All sound stays on the device.

import { checkOptions } from "./engine/options.js";
import { FrameTrack } from "./frame-track.js";

const SHOW_AFTER_S = 0.1; // time from the sound to its face: the lips' delay, blocks, one frame, and the computation
const DEFAULT_SHAPES = ["arkit"];
const OPTIONS = ["models", "phones", "context", "shapes", "expressiveness", "feeling", "delayMs"];
const MAX_LATE_S = 0.5; // maximum time from the sound to its face
const LIVE_TRACK_S = 60; // how long the frames of listenTo() are kept
const PUSHED_TRACK_S = 3600; // of push(), because audio may arrive long before its face is shown
const TELEPHONE_HZ = 8000;
const USER_GESTURES = ["pointerdown", "keydown"]; // events in which browsers allow sound to start
const MODELS = new URL("models/", import.meta.url);

const TEXTS = {
  insecure: "the browser offers no microphone to this page; open it by https:// or from localhost",
  NotAllowedError: "the microphone is blocked; allow it in the address bar of the browser, and try again",
  NotFoundError: "no microphone was found; connect one, and try again",
  NotReadableError: "another program uses the microphone, or it is broken; close that program, and try again",
  unplugged: "the microphone was unplugged; connect it, and start again",
  telephone: "the microphone sends 8 kHz, as a telephone does, so the lips are less accurate; choose another microphone",
  suspended: "the browser has not started the sound yet; click on the page",
  interrupted: "the system paused the sound, for example for a call; it continues afterwards",
  slow: "this device is too slow for final phones; turn them off",
  hidden: "the tab is in the background; the lips follow the sound again when it is visible",
};

/** Lip sync of one voice at a time; index.d.ts describes the API. */
export class LipSync extends EventTarget {
  #worker;
  #options;
  #context;
  #ownsContext;
  #session = 0; // number of the newest
  #track = new FrameTrack(LIVE_TRACK_S);
  #source = null; // { node, notice: about the source, or "", release() }
  #choice = 0; // number of the newest choice of a source, or of none
  #startS = null; // start of the session on the context's clock; null before the first sound, and for push()
  #isPushed = false; // whether push() can be called
  #isPlayed = false; // whether the page plays the sound
  #pending = null; // the request that the worker has not answered: { message, answer, resolve, reject }
  #isSpeaking = false;
  #isLaughing = false;
  #mayBeSlow = false; // with final phones
  #isClosed = false;

  /** Names of the weights of each set. */
  names = {};

  /** Use LipSync.create instead. */
  constructor(worker, context, options) {
    super();
    this.#worker = worker;
    this.#context = context;
    this.#ownsContext = context === null;
    this.#options = options;
    context?.addEventListener("statechange", this.#onContextState);
    worker.onmessage = ({ data }) => this.#onMessage(data);
    document.addEventListener("visibilitychange", this.#onVisibility);
  }

  /** Load the models and the worker. */
  static async create({ models = MODELS, phones = true, context = null, shapes = DEFAULT_SHAPES, ...options } = {}) {
    checkOptions(options, OPTIONS);
    // Bundlers find the file only if its URL is written here.
    const worker = new Worker(new URL("worker.js", import.meta.url), { type: "module" });
    const lips = new LipSync(worker, context, { shapes, ...options });
    lips.#mayBeSlow = phones === "final";
    worker.onerror = () => lips.#fail("cannot start worker.js of kouxing-lips; serve the package from the page's own origin, or copy it next to your bundle");
    try {
      await lips.#request("loaded", { type: "load", models: new URL(models, location.href).href, phones });
    } catch (error) {
      lips.close();
      throw error;
    }
    return lips;
  }

  /** Follow the microphone. If it cannot be opened, rejects with a message that says what to do. */
  async listenToMicrophone(constraints = {}) {
    this.#checkOpen();
    if (!navigator.mediaDevices) throw new Error(TEXTS.insecure);
    const audio = { channelCount: 1, echoCancellation: true, autoGainControl: true, ...constraints };
    const choice = ++this.#choice;
    let stream;
    try {
      stream = await navigator.mediaDevices.getUserMedia({ audio });
    } catch (error) {
      throw new Error(TEXTS[error.name] ?? `the microphone cannot be opened: ${error.message}`, { cause: error });
    }
    const [track] = stream.getAudioTracks();
    const end = () => {
      track.onended = null;
      track.stop();
    };
    try {
      this.#check(choice);
      const notice = track.getSettings().sampleRate <= TELEPHONE_HZ ? TEXTS.telephone : "";
      if (notice) this.#report(notice);
      track.onended = () => {
        this.stop();
        this.#report(TEXTS.unplugged);
      };
      await this.#follow(stream, choice, end, notice);
    } catch (error) {
      end();
      throw error;
    }
  }

  /**
   * Follow a MediaStream, a track, an AudioBuffer, a media element or an audio node of this.context.
   * Buffers and elements are also played, delayed like the face.
   */
  async listenTo(source) {
    await this.#follow(source, ++this.#choice);
  }

  /** Start a session for push(). Its times count from the first sample. */
  async open(sampleRateHz) {
    this.stop();
    const choice = this.#choice;
    await this.#open({ sampleRateHz });
    this.#check(choice);
    this.#isPushed = true;
  }

  /** Accept PCM, mono in [-1, 1], at the rate of open(). Audio may arrive faster than real time. */
  push(samples) {
    this.#checkPushed();
    this.#worker.postMessage({ type: "push", session: this.#session, samples });
  }

  /** End pushed audio. Resolves when all its frames are known. */
  async finish() {
    this.#checkPushed();
    this.#isPushed = false;
    await this.#request("finished", { type: "finish", session: this.#session });
  }

  /** Show expressions, strengths 0 to 1 by name, for a time. */
  express(strengths, holdS = 3) {
    this.#worker.postMessage({ type: "express", strengths, holdS });
  }

  /** The audio context of this lip sync. */
  get context() {
    if (this.#context === null) {
      this.#checkOpen();
      this.#context = new AudioContext({ latencyHint: "interactive" });
      this.#context.addEventListener("statechange", this.#onContextState);
    }
    return this.#context;
  }

  /** The audio node of the current source, for example for a meter; null without one. */
  get node() {
    return this.#source?.node ?? null;
  }

  /** Start suspended sound. Browsers allow this only in a click handler. */
  async resume() {
    if (this.context.state === "running") return;
    const started = this.context.resume();
    const isBlocked = await Promise.race([started.then(() => false), new Promise((done) => setTimeout(done, 300, true))]);
    if (!isBlocked || this.#isClosed) return;
    this.#report(TEXTS.suspended);
    for (const type of USER_GESTURES) document.addEventListener(type, this.#resumeContext, { once: true });
  }

  /** The face to show now, for sound from listenTo(): { faps, arkit, ... }; null before the first. */
  get current() {
    if (this.#startS === null) return this.#track.at(Infinity);
    const latencyS = this.#isPlayed ? (this.#context.outputLatency ?? 0) : 0;
    return this.#track.at(this.#context.currentTime - this.#startS - SHOW_AFTER_S - latencyS);
  }

  /** Return the face at a time of the session, seconds. */
  at(timeS) {
    return this.#track.at(timeS);
  }

  /** Stop following the sound. The face returns to rest. */
  stop() {
    this.#choice++;
    this.#release();
  }

  /** Stop, and release all resources. */
  close() {
    if (this.#isClosed) return;
    this.#isClosed = true;
    this.stop();
    this.#supersede();
    document.removeEventListener("visibilitychange", this.#onVisibility);
    for (const type of USER_GESTURES) document.removeEventListener(type, this.#resumeContext);
    this.#worker.terminate();
    this.#context?.removeEventListener("statechange", this.#onContextState);
    if (this.#ownsContext) this.#context?.close();
  }

  /** Follow the source of a choice. onRelease is called when it is no longer followed. The notice is about the source. */
  async #follow(source, choice, onRelease = () => {}, notice = "") {
    this.#checkOpen();
    const context = this.context;
    if (context.state === "closed") throw new Error("the audio context is closed; create lip sync with an open one");
    await context.audioWorklet.addModule(new URL("worklet.js", import.meta.url));
    this.#check(choice);
    const node = sourceNode(context, source); // a wrong source does not end the current one
    this.#release();
    const { port1, port2 } = new MessageChannel();
    await this.#open({ sampleRateHz: context.sampleRate }, port1);
    this.#check(choice);
    const input = new AudioWorkletNode(context, "kouxing-lips", { channelCount: 1, channelCountMode: "explicit", numberOfOutputs: 0 });
    const output = elementOutputs.get(source);
    const isBuffer = isInstance(source, "AudioBuffer");
    this.#isPlayed = isBuffer || output !== undefined;
    node.connect(input);
    if (isBuffer) node.connect(new DelayNode(context, { delayTime: SHOW_AFTER_S })).connect(context.destination);
    if (output) changeFollowers(output, 1);
    this.#source = {
      node,
      notice,
      release() {
        input.port.postMessage(null);
        node.disconnect(input);
        if (output) changeFollowers(output, -1);
        if (isBuffer) {
          node.onended = null;
          node.stop();
          node.disconnect();
        }
        onRelease();
      },
    };
    input.port.postMessage(port2, [port2]);
    if (isBuffer) {
      node.start();
      node.onended = () => this.dispatchEvent(new Event("ended"));
    }
    await this.resume();
  }

  /** Throw an AbortError if another source was chosen, or none. The caller can ignore it. */
  #check(choice) {
    if (choice !== this.#choice) throw abortError();
  }

  #checkOpen() {
    if (this.#isClosed) throw new Error("this lip sync is closed; create another one");
  }

  #checkPushed() {
    this.#checkOpen();
    if (!this.#isPushed) throw new Error("no sound is open for push(); call open(), and wait until it has opened");
  }

  #release() {
    if (this.#source === null && !this.#isPushed) return;
    this.#source?.release();
    this.#source = null;
    this.#isPushed = false;
    this.#worker.postMessage({ type: "finish", session: this.#session });
  }

  async #open(options, input = null) {
    this.#track = new FrameTrack(input ? LIVE_TRACK_S : PUSHED_TRACK_S);
    this.#startS = null;
    const session = ++this.#session;
    const message = { type: "open", session, options: { ...this.#options, ...options }, input };
    await this.#request("opened", message, input ? [input] : []);
  }

  /** Send a request to the worker, and wait for its answer. It replaces an unanswered request. */
  async #request(answer, message, transfer = []) {
    this.#checkOpen();
    this.#supersede();
    return new Promise((resolve, reject) => {
      this.#pending = { message, answer, resolve, reject };
      this.#worker.postMessage(message, transfer);
    });
  }

  /** Reject the unanswered request. Its caller can ignore an AbortError. */
  #supersede() {
    this.#pending?.reject(abortError());
    this.#pending = null;
  }

  #fail(text) {
    const request = this.#pending;
    this.#pending = null;
    if (request) request.reject(new Error(text));
    else this.#report(text);
  }

  #onMessage({ type, ...data }) {
    if (type === "error") {
      const { message } = this.#pending ?? {};
      if (data.request === message?.type && data.session === message.session) this.#fail(data.text);
      else this.#report(data.text);
      return;
    }
    if (type !== "loaded" && data.session !== this.#session) return;
    if (type === "frames") {
      this.#onFrames(data);
      return;
    }
    if (type === "opened") this.names = data.names;
    if (type !== this.#pending?.answer) return;
    this.#pending.resolve();
    this.#pending = null;
  }

  #onFrames({ frames, phones, startS }) {
    for (const phone of phones) this.dispatchEvent(new CustomEvent("phone", { detail: phone }));
    if (frames.length === 0) return;
    this.#track.push(frames);
    const { timeS, isSpeaking, isLaughing } = frames.at(-1);
    if (this.#source) {
      this.#startS = startS;
      if (this.#mayBeSlow && this.#context.currentTime - startS - timeS > MAX_LATE_S) {
        this.#mayBeSlow = false; // one notice is enough
        this.#report(TEXTS.slow);
      }
    }
    if (isSpeaking !== this.#isSpeaking || isLaughing !== this.#isLaughing) {
      [this.#isSpeaking, this.#isLaughing] = [isSpeaking, isLaughing];
      this.dispatchEvent(new CustomEvent("voice", { detail: { timeS, isSpeaking, isLaughing } }));
    }
    this.dispatchEvent(new CustomEvent("frames", { detail: { frames, startS } }));
  }

  #onContextState = () => {
    if (this.#source === null) return;
    if (this.#context.state === "interrupted") this.#report(TEXTS.interrupted);
    else if (this.#context.state === "running") this.#report(this.#source.notice);
  };

  #onVisibility = () => {
    if (this.#source === null) return;
    if (document.hidden) {
      this.#report(TEXTS.hidden);
      return;
    }
    this.#onContextState(); // a context that ran all the time reports no change
    this.#resumeContext();
  };

  #resumeContext = () => {
    this.#context.resume().catch(() => {}); // fails if the page has closed its context
  };

  #report(text) {
    this.dispatchEvent(new CustomEvent("notice", { detail: text }));
  }
}

function abortError() {
  return new DOMException("another source was opened, or lip sync was stopped or closed", "AbortError");
}

/** Return whether an object is an instance of a class of the browser, also of another realm, such as an iframe. */
function isInstance(object, className) {
  if (object === null || object === undefined) return false;
  return object.constructor?.name === className || isInstance(Object.getPrototypeOf(object), className);
}

// An element allows only one node, and is heard only through it: { node, delay, numFollowers } by element. The delay is
// zero while no lip sync follows the element. Several can follow it, for example for several avatars.
const elementOutputs = new WeakMap();

function changeFollowers(output, change) {
  output.numFollowers += change;
  output.delay.delayTime.value = output.numFollowers > 0 ? SHOW_AFTER_S : 0;
}

/** Return the audio node of a source. */
function sourceNode(context, source) {
  const current = isInstance(source, "AudioNode") ? source : elementOutputs.get(source)?.node;
  if (current && current.context !== context) {
    throw new Error("the source belongs to another audio context; pass that context to LipSync.create() as context");
  }
  if (current) return current;
  if (isInstance(source, "MediaStreamTrack")) source = new MediaStream([source]);
  if (isInstance(source, "MediaStream")) {
    if (source.getAudioTracks().length === 0) throw new Error("the stream has no audio track");
    return new MediaStreamAudioSourceNode(context, { mediaStream: source });
  }
  if (isInstance(source, "AudioBuffer")) return new AudioBufferSourceNode(context, { buffer: source });
  if (isInstance(source, "HTMLMediaElement")) {
    const node = new MediaElementAudioSourceNode(context, { mediaElement: source });
    const delay = new DelayNode(context);
    node.connect(delay).connect(context.destination);
    elementOutputs.set(source, { node, delay, numFollowers: 0 });
    return node;
  }
  throw new TypeError("expected a MediaStream, a track, an AudioBuffer, an <audio> or <video> element, or an audio node");
}
