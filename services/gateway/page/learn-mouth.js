// "Learn my mouth": records the own lips and speech, has the gateway learn from them, shows what it
// brought, and keeps it or not.

import { pathOf } from "./address.js";
import { capture, openCaptureContext } from "./capture.js";
import { element } from "./elements.js";
import { FaceTracker } from "./face-tracker.js";
import { say } from "./language.js";
import { curvePath, extent, figures, verdict } from "./lip-curves.js";
import { TEXTS } from "./reading.js";
import { FaceRecording } from "./recording.js";

const CLOSED_LIPS_MS = 3000; // before the reading, to see the face at rest
const MIN_READING = 0.5; // share of the time after which one may have finished
const CURVES = ["tracked", "before", "after"];
const BOX = { width: 600, height: 150 };
const NEEDS = {
  NotAllowedError:
    { en: "Camera and microphone were not allowed: allow them for this page and try again.", zh: "未允许使用摄像头和麦克风：请允许后重试。" },
  NotFoundError: { en: "There is no camera or no microphone: plug one in and try again.", zh: "没有摄像头或麦克风：请接上后重试。" },
  NotReadableError:
    { en: "Another program holds the camera or the microphone: close it and try again.", zh: "摄像头或麦克风被其他程序占用：请关闭后重试。" },
};
const UNPLUGGED = { en: "Camera or microphone were unplugged: try again.", zh: "摄像头或麦克风断开了，请重试。" };
const NEEDS_SECURE =
  { en: "A camera needs https, or this page at http://localhost or http://127.0.0.1.", zh: "使用摄像头需要 https 或 localhost。" };

const STARTING = { en: "Camera and microphone start …", zh: "正在启动摄像头和麦克风…" };
const SHOW_FACE = { en: "Show your face to the camera.", zh: "请把脸对准摄像头。" };
const LIPS_CLOSED = { en: "Keep your lips closed …", zh: "请先闭上嘴…" };
const READ = { en: "Read aloud, again if time is left.", zh: "请朗读，读完可重复。" };
const NO_ANSWER = {
  en: "The gateway does not answer; is 'kouxing run' running?",
  zh: "网关没有应答：kouxing run 在运行吗？",
};

const dialog = element("learn-mouth");

export class MouthLesson {
  readingS = 40;
  #profiles;
  #handlers;
  #stop = new AbortController(); // of what is going on
  #finish = () => {}; // ends the reading
  #recording = null; // landmark file that nothing was learnt from yet
  #learnt = null; // profile that the user has neither kept nor discarded

  /**
   * @param profiles MouthProfileStore
   * @param handlers { opened(), closed(), profileChanged() }
   */
  constructor(profiles, handlers) {
    this.#profiles = profiles;
    this.#handlers = handlers;
    element("lesson-text").value = document.documentElement.lang;
    for (const [id, act] of Object.entries({
      "lesson-start": () => this.#record(),
      "lesson-finish": () => this.#finish(),
      "lesson-resend": () => this.#learn(),
      "lesson-again": () => this.#record(),
      "lesson-keep": () => this.#keep(),
      "lesson-forget": () => this.#forget(),
    })) {
      element(id).onclick = act;
    }
    for (const button of dialog.querySelectorAll(".close")) button.onclick = () => dialog.close();
    dialog.onclose = () => {
      this.#stop.abort();
      handlers.closed();
    };
  }

  /** "closed", or what the lesson is at: "intro", "reading", "learning", "result" or "problem". */
  get step() {
    return dialog.open ? dialog.dataset.step : "closed";
  }

  open() {
    this.#recording = this.#learnt = null;
    const { current } = this.#profiles;
    element("lesson-profile").hidden = current === null;
    if (current !== null) {
      const [, before, after] = figures(current)[0];
      const day = new Date(current.learntOn).toLocaleDateString();
      element("lesson-profile").firstElementChild.textContent =
        say({
          en: `Your mouth was learnt on ${day}: opening ${before} → ${after}.`,
          zh: `${day} 学会了你的口型：张口 ${before} → ${after}。`,
        });
    }
    const isSecure = navigator.mediaDevices !== undefined;
    element("lesson-start").disabled = !isSecure;
    element("lesson-insecure").hidden = isSecure;
    element("lesson-insecure").textContent = say(NEEDS_SECURE);
    this.#show("intro");
    dialog.showModal();
    this.#handlers.opened();
  }

  #show(step) {
    dialog.dataset.step = step;
  }

  #fail(text) {
    element("lesson-problem").textContent = text;
    element("lesson-resend").hidden = this.#recording === null;
    this.#show("problem");
  }

  // --- recording ---------------------------------------------------------------------------------

  async #record() {
    this.#stop = new AbortController();
    this.#prepare();
    const recording = await this.#film(this.#stop.signal);
    if (recording === null) return;
    const problem = recording.problem();
    if (problem === null) {
      this.#recording = recording.encode();
      this.#learn();
    } else {
      this.#fail(say(problem));
    }
  }

  /** Return what was recorded; null if that was stopped, or if it failed, which is shown. */
  async #film(signal) {
    const tracker = new FaceTracker();
    let stream = null;
    let context = null;
    try {
      stream = await navigator.mediaDevices.getUserMedia({
        audio: { echoCancellation: true, autoGainControl: true, channelCount: 1 },
        video: { facingMode: "user", width: { ideal: 640 }, height: { ideal: 480 } },
      });
      const video = element("lesson-video");
      video.srcObject = stream;
      [context] = await Promise.all([openCaptureContext(), tracker.load(), video.play()]);
      signal.throwIfAborted();
      const recording = new FaceRecording(context.sampleRate);
      await this.#read(recording, { video, tracker, context, stream, signal });
      return signal.aborted ? null : recording;
    } catch (error) {
      if (!signal.aborted) this.#fail(NEEDS[error.name] ? say(NEEDS[error.name]) : error.message);
      return null;
    } finally {
      for (const track of stream?.getTracks() ?? []) track.stop();
      context?.close();
      tracker.close();
    }
  }

  #prepare() {
    this.#recording = null;
    const language = element("lesson-text").value;
    element("lesson-reading").lang = language;
    element("lesson-reading").textContent = TEXTS[language];
    element("lesson-reading").classList.remove("due");
    element("lesson-finish").disabled = true;
    element("lesson-time").value = 0;
    element("lesson-count").textContent = "";
    element("lesson-advice").textContent = say(STARTING);
    this.#show("reading");
  }

  /** Record until the time is over, beginning when a face is seen. */
  async #read(recording, { video, tracker, context, stream, signal }) {
    let beganMs = null;
    let isOver = false;
    const over = new Promise((resolve, reject) => {
      this.#finish = () => {
        isOver = true;
        resolve({});
      };
      signal.addEventListener("abort", this.#finish);
      for (const track of stream.getTracks()) track.onended = () => reject(new Error(say(UNPLUGGED)));
    });
    let next = nextPicture(video);
    while (!isOver) {
      const { takenMs, picture } = await Promise.race([next, over]);
      if (isOver) break;
      next = nextPicture(video); // while the face is sought in this one
      const landmarks = await tracker.find(picture);
      drawLips(video, tracker.lips, landmarks);
      if (beganMs === null && landmarks !== null) {
        beganMs = performance.now();
        capture(context, stream, (chunk, rms, recordedMs) =>
          recording.addSound(recordedMs, chunk, rms),
        );
      }
      if (beganMs !== null) recording.addFace(takenMs, landmarks);
      this.#tellTime(beganMs, recording);
    }
  }

  #tellTime(beganMs, recording) {
    const nowMs = performance.now();
    if (beganMs === null) {
      element("lesson-advice").textContent = say(SHOW_FACE);
      return;
    }
    const readingMs = nowMs - beganMs - CLOSED_LIPS_MS;
    const leftS = Math.ceil((readingMs < 0 ? -readingMs : 1000 * this.readingS - readingMs) / 1000);
    element("lesson-count").textContent = leftS;
    element("lesson-time").value = Math.max(0, readingMs / (1000 * this.readingS));
    element("lesson-reading").classList.toggle("due", readingMs >= 0);
    element("lesson-finish").disabled = readingMs < 1000 * MIN_READING * this.readingS;
    const advice = recording.advice(nowMs) ?? (readingMs < 0 ? LIPS_CLOSED : READ);
    element("lesson-advice").textContent = say(advice);
    if (leftS <= 0) this.#finish();
  }

  // --- learning ----------------------------------------------------------------------------------

  async #learn() {
    this.#stop = new AbortController();
    const { signal } = this.#stop;
    this.#show("learning");
    let answer;
    try {
      const response = await fetch(pathOf("learn-mouth"), { method: "POST", body: this.#recording, signal });
      const isJson = response.headers.get("Content-Type")?.startsWith("application/json");
      answer = isJson ? await response.json() : { error: await response.text() };
    } catch {
      answer = { error: say(NO_ANSWER) };
    }
    if (signal.aborted) return;
    if (answer.error !== undefined) {
      this.#fail(answer.error);
      return;
    }
    const { voice: profile, before, after } = answer;
    this.#learnt = { profile, learntOn: Date.now(), before, after };
    this.#recording = null;
    this.#showResult(answer);
  }

  #showResult({ before, after, curves }) {
    element("lesson-verdict").textContent = say(verdict({ before, after }));
    const rows = figures({ before, after }).map((cells) => {
      const row = document.createElement("tr");
      row.append(...cells.map((text, index) => cell(index === 0 ? say(text) : text, index === 0 ? "th" : "td")));
      return row;
    });
    element("lesson-figures").replaceChildren(...rows);
    const box = { ...BOX, ...extent(...CURVES.map((name) => curves.opening[name])) };
    for (const name of CURVES) {
      const path = curvePath(curves.time_s, curves.opening[name], box);
      element(`lesson-${name}`).setAttribute("d", path);
    }
    this.#show("result");
  }

  #keep() {
    this.#profiles.keep(this.#learnt);
    this.#handlers.profileChanged();
    dialog.close();
  }

  #forget() {
    this.#profiles.forget();
    this.#handlers.profileChanged();
    dialog.close();
  }
}

/** Wait for the video's next picture; return it and when it was taken, by the page's clock. */
async function nextPicture(video) {
  const takenMs = await new Promise((resolve) => {
    video.requestVideoFrameCallback((nowMs, { captureTime }) => resolve(captureTime ?? nowMs));
  });
  return { takenMs, picture: await createImageBitmap(video) };
}

function drawLips(video, lips, landmarks) {
  const canvas = element("lesson-lips");
  canvas.width = video.videoWidth; // which also clears it
  canvas.height = video.videoHeight;
  if (landmarks === null) return;
  const pen = canvas.getContext("2d");
  pen.strokeStyle = getComputedStyle(canvas).color;
  pen.lineWidth = (1.5 * canvas.width) / canvas.clientWidth;
  for (const [from, to] of lips) {
    pen.moveTo(landmarks[3 * from], landmarks[3 * from + 1]);
    pen.lineTo(landmarks[3 * to], landmarks[3 * to + 1]);
  }
  pen.stroke();
}

function cell(text, kind) {
  const made = document.createElement(kind);
  made.textContent = text;
  return made;
}
