// Streams the microphone, or a file in its place, into a separate session.

import { socketUrl } from "./address.js";
import { AudioUplink } from "./audio-uplink.js";
import { capture, captureRateHz, openCaptureContext, openFileSpeech } from "./capture.js";
import { UserError, translate } from "./language.js";

const RETRY_MS = 500;
const TAIL_MS = 1000; // silence after a file, for its last frames
const GIVE_UP_MS = 60000; // longer than the restart of a crashed service on a busy machine

export class Microphone {
  #handlers;
  #run = null; // identifies the time from one start to its stop
  #socket = null;
  #stream = null;
  #fileSpeech = null;
  #context = null;
  #uplink = null; // while it streams
  #retryTimer = null;
  #giveUpMs = null; // when to stop reconnecting; null before it has streamed

  /**
   * @param handlers { mouthProfile(): base64 or "", language(): of the speech, lipModel(): initial lip model or null,
   *   state("off" | "starting" | "on" | "interrupted"), level(rms), session(name),
   *   fileEnded(name), error({ code, text }) }
   */
  constructor(handlers) {
    this.#handlers = handlers;
  }

  /** Whether it streams or is starting. */
  get isActive() {
    return this.#run !== null;
  }

  /** Whether it streams or opens a file. */
  get isFile() {
    return this.#run?.isFile ?? false;
  }

  /** Return how long ago a media time of its session was spoken, ms; null if it does not stream. */
  ageMs(nowMs, mediaTime) {
    return this.#uplink?.ageMs(nowMs, mediaTime) ?? null;
  }

  /** Change the lip model of its session. */
  chooseLipModel(name) {
    if (this.#uplink) this.#socket.send(JSON.stringify({ lip_model: name }));
  }

  start() {
    return this.#startFrom(async (source, run) => {
      if (!navigator.mediaDevices) throw new UserError(translate("microphoneInsecure"));
      source.stream = await navigator.mediaDevices.getUserMedia({
        audio: { echoCancellation: true, autoGainControl: true, channelCount: 1 },
      });
      for (const track of source.stream.getTracks()) {
        track.onended = () => this.#run === run && this.#fail(translate("microphoneUnplugged"));
        track.onmute = () => this.#run === run && this.#report(translate("microphoneMuted"));
        if (track.muted) track.onmute();
      }
      source.context = await openCaptureContext();
    });
  }

  /** Stream a file. */
  startFile(file) {
    return this.#startFrom(async (source) => {
      source.context = await openCaptureContext();
      source.fileSpeech = await openFileSpeech(source.context, file);
      source.stream = source.fileSpeech.stream;
      const { remarks } = source.fileSpeech;
      if (remarks !== "") this.#handlers.error({ code: "file", text: remarks });
    }, true);
  }

  /** Open a source with open(source, run) and stream it, unless it is stopped in the meantime. */
  async #startFrom(open, isFile = false) {
    this.stop();
    const run = { isFile, hasPlayed: false };
    this.#run = run;
    this.#handlers.state("starting");
    const source = { stream: null, context: null, fileSpeech: null };
    let problem = null;
    try {
      await open(source, run);
      if (this.#run === run) this.#capture(source);
    } catch (error) {
      problem = problemText(error, isFile);
    }
    if (this.#run !== run || problem !== null) release(source);
    if (this.#run !== run) return;
    if (problem !== null) {
      this.#fail(problem);
      return;
    }
    ({ stream: this.#stream, context: this.#context, fileSpeech: this.#fileSpeech } = source);
    this.#connect();
  }

  #capture({ context, stream }) {
    capture(context, stream, (chunk, rms, recordedMs) => {
      this.#handlers.level(rms);
      if (this.#uplink !== null) this.#send(performance.now(), recordedMs, chunk);
    });
  }

  /** Send a chunk. Reconnect if the network is down, which the socket reports only after minutes. */
  #send(nowMs, recordedMs, chunk) {
    this.#uplink.send(nowMs, recordedMs, chunk);
    if (!this.#uplink.isDown(nowMs)) return;
    const socket = this.#socket;
    this.#socket = null;
    socket.close();
    this.#onClosed(null);
  }

  stop() {
    const socket = this.#socket;
    clearTimeout(this.#retryTimer);
    release({ stream: this.#stream, context: this.#context });
    this.#socket = this.#stream = this.#fileSpeech = this.#context = this.#uplink = null;
    this.#giveUpMs = this.#run = null;
    socket?.close();
    this.#handlers.level(0);
    this.#handlers.state("off");
  }

  #connect() {
    const socket = new WebSocket(socketUrl("/microphone"));
    let rejection = null;
    this.#socket = socket;
    socket.onopen = () => {
      const format = { sample_rate_hz: captureRateHz(this.#context), num_channels: 1, encoding: "s16le" };
      const [profile, language] = [this.#handlers.mouthProfile(), this.#handlers.language()];
      socket.send(JSON.stringify({ ...format, mouth_profile: profile, language }));
    };
    socket.onmessage = (event) => {
      if (this.#socket !== socket) return;
      const message = JSON.parse(event.data);
      if (message.type === "opened") this.#onOpened(message.session);
      else if (this.#uplink !== null && message.type === "error") this.#handlers.error(message);
      else rejection = message;
    };
    socket.onclose = () => {
      if (this.#socket === socket) this.#onClosed(rejection);
    };
  }

  #onOpened(session) {
    this.#uplink = new AudioUplink(this.#socket, captureRateHz(this.#context));
    this.#giveUpMs = null;
    this.#handlers.session(session);
    this.#handlers.state("on");
    this.#playFile();
    const name = this.#handlers.lipModel();
    if (name !== null) this.chooseLipModel(name);
  }

  /** Start the file. It continues while the connection is interrupted. */
  #playFile() {
    const run = this.#run;
    if (!run.isFile || run.hasPlayed) return;
    run.hasPlayed = true;
    this.#fileSpeech.play(() => setTimeout(() => this.#run === run && this.#endFile(), TAIL_MS));
  }

  #endFile() {
    this.#handlers.fileEnded(this.#fileSpeech.name);
    this.stop();
  }

  /** Reconnect if it has streamed: a service or the gateway is being restarted. */
  #onClosed(rejection) {
    if (this.#uplink !== null) {
      this.#uplink = null;
      this.#giveUpMs = performance.now() + GIVE_UP_MS;
      this.#handlers.state("interrupted");
    }
    if (this.#giveUpMs !== null && performance.now() < this.#giveUpMs) {
      this.#retryTimer = setTimeout(() => this.#connect(), RETRY_MS);
    } else if (rejection?.code) {
      this.#handlers.error(rejection);
      this.stop();
    } else {
      this.#fail(translate(this.isFile ? "fileStopped" : "microphoneStopped"));
    }
  }

  #report(text) {
    this.#handlers.error({ code: "microphone", text });
  }

  #fail(text) {
    this.#report(text);
    this.stop();
  }
}

function problemText(error, isFile) {
  if (error instanceof UserError) return error.message;
  if (error.name === "NotAllowedError") return translate("microphoneForbidden");
  if (error.name === "NotFoundError") return translate("microphoneMissing");
  const reason = error.message.replace(/\.$/, ""); // Firefox writes a period
  return translate(isFile ? "fileFailed" : "microphoneFailed", { reason });
}

function release({ stream, context }) {
  for (const track of stream?.getTracks() ?? []) track.stop();
  context?.close();
}
