// The dialog "Learn my mouth": it records lips and voice, sends the recording to the gateway, shows
// the learned result, and stores it if the user keeps it.

import { pathWithToken } from "./address.js";
import { capture, captureRateHz, openCaptureContext } from "./capture.js";
import { element } from "./elements.js";
import { FaceRecording } from "./face-recording.js";
import { FaceTracker } from "./face-tracker.js";
import { UserError, translate, translateResponse } from "./language.js";
import { curvePath, extent, correlationRows, verdict } from "./lip-curves.js";
import { READING_TEXTS } from "./texts.js";

const CLOSED_LIPS_MS = 3000; // time before reading in which the face at rest is recorded
const SLOW_MS = 100; // a tracker that needs longer for an image runs only after the reading
const MIN_SLOW = 2; // consecutive slow images; the first image is slow on any computer
const SLOW_IMAGE = { everyMs: 110, widthPx: 320 }; // images that wait until the reading is over
const SLOW_FACTOR = 1.5; // multiple of the usual time
const MIN_READING = 0.5; // fraction of the time after which the user may finish
const CURVES = ["tracked", "before", "after"];
const BOX = { width: 600, height: 150 };
const CAMERA_ERRORS = {
  NotAllowedError: "cameraForbidden",
  NotFoundError: "cameraMissing",
  NotReadableError: "cameraBusy",
};

const dialog = element("learn-mouth");

export class LearnMouthDialog {
  readingS = 40;
  #profiles;
  #handlers;
  #abort = new AbortController(); // ends the current step
  #finish = () => {}; // ends the reading
  #numSlow = 0; // consecutive images that took the tracker long
  #recording = null; // landmark file that is not yet learned from
  #learned = null; // profile that the user has neither kept nor discarded

  /** @param handlers { opened(), closed(), profileChanged() } */
  constructor(profiles, handlers) {
    this.#profiles = profiles;
    this.#handlers = handlers;
    for (const [id, onClick] of Object.entries({
      "learn-start": () => this.#record(),
      "learn-finish": () => this.#finish(),
      "learn-resend": () => this.#learn(),
      "learn-again": () => this.#record(),
      "learn-keep": () => this.#keep(this.#learned),
      "learn-forget": () => this.#keep(null),
    })) {
      element(id).onclick = onClick;
    }
    for (const button of dialog.querySelectorAll(".close")) button.onclick = () => dialog.close();
    dialog.onclose = () => {
      this.#abort.abort();
      handlers.closed();
    };
  }

  /** "closed", or the current step: "intro", "reading", "learning", "result" or "problem". */
  get step() {
    return dialog.open ? dialog.dataset.step : "closed";
  }

  open() {
    this.#recording = this.#learned = null;
    const { lang } = document.documentElement;
    element("learn-text").value = lang;
    const { current } = this.#profiles;
    element("learn-profile").hidden = current === null;
    if (current !== null) {
      const [, before, after] = correlationRows(current)[0];
      const day = new Date(current.learnedOn).toLocaleDateString(lang);
      element("learn-profile").firstElementChild.textContent =
        translate("learnedOn", { day, before, after });
    }
    const isSecure = navigator.mediaDevices !== undefined;
    element("learn-start").disabled = !isSecure;
    element("learn-insecure").hidden = isSecure;
    element("learn-insecure").textContent = translate("cameraInsecure");
    this.#show("intro");
    dialog.showModal();
    this.#handlers.opened();
  }

  #show(step) {
    dialog.dataset.step = step;
    for (const section of dialog.querySelectorAll("section")) {
      section.hidden = section.dataset.step !== step;
      if (!section.hidden) section.focus(); // the button that had the focus is hidden
    }
  }

  #fail(text) {
    element("learn-problem").textContent = text;
    element("learn-resend").hidden = this.#recording === null;
    this.#show("problem");
  }

  // --- recording ---------------------------------------------------------------------------------

  async #record() {
    this.#abort = new AbortController();
    this.#prepare();
    const recording = await this.#recordFace(this.#abort.signal);
    if (recording === null) return;
    const problem = recording.problem();
    if (problem === null) {
      this.#recording = recording.encode();
      this.#learn();
    } else {
      this.#fail(translate(problem));
    }
  }

  get #isSlow() {
    return this.#numSlow >= MIN_SLOW;
  }

  /** Return the recording; null if it was aborted or failed. A failure is shown. */
  async #recordFace(signal) {
    const tracker = new FaceTracker();
    let stream = null;
    let context = null;
    const stop = () => {
      document.onvisibilitychange = null;
      for (const track of stream?.getTracks() ?? []) track.stop();
      if (context?.state !== "closed") context?.close();
    };
    signal.addEventListener("abort", () => {
      stop();
      tracker.close();
    });
    try {
      stream = await navigator.mediaDevices.getUserMedia({
        audio: { echoCancellation: true, autoGainControl: true, channelCount: 1 },
        video: { facingMode: "user", width: { ideal: 640 }, height: { ideal: 480 } },
      });
      signal.throwIfAborted(); // the browser may ask for permission after the dialog was closed
      const video = element("learn-video");
      video.srcObject = stream;
      context = await openCaptureContext();
      await Promise.all([tracker.load(), video.play()]);
      signal.throwIfAborted();
      const recording = new FaceRecording(captureRateHz(context));
      const images = await this.#read(recording, { video, tracker, context, stream, signal });
      stop();
      await this.#findFaces(images, recording, tracker, signal);
      return signal.aborted ? null : recording;
    } catch (error) {
      if (!signal.aborted) this.#fail(errorText(error));
      return null;
    } finally {
      stop();
      tracker.close();
    }
  }

  #prepare() {
    this.#recording = null;
    this.#numSlow = 0;
    const language = element("learn-text").value;
    element("learn-reading").lang = language;
    element("learn-reading").textContent = READING_TEXTS[language];
    element("learn-reading").classList.remove("due");
    element("learn-finish").disabled = true;
    element("learn-time").value = 0;
    element("learn-count").textContent = "";
    element("learn-advice").textContent = translate("learnStarting");
    this.#show("reading");
  }

  /**
   * Record from the first face until the time is over. If the tracker is slow, it does not run while
   * the user reads. Return the images that it must still analyze, as { takenMs, image }.
   */
  async #read(recording, { video, tracker, context, stream, signal }) {
    let startMs = null;
    let isOver = false;
    const images = [];
    const over = new Promise((resolve, reject) => {
      this.#finish = () => {
        isOver = true;
        resolve({});
      };
      signal.addEventListener("abort", this.#finish);
      const fail = (text) => reject(new UserError(translate(text)));
      for (const track of stream.getTracks()) track.onended = () => fail("cameraUnplugged");
      // browsers take no images of a camera for a hidden page
      document.onvisibilitychange = () => document.hidden && fail("learnHidden");
    });
    const take = (previousMs) => nextImage(video, this.#isSlow ? { previousMs, ...SLOW_IMAGE } : {});
    let next = take();
    let numImages = 0; // since the first face
    let isRateChecked = false;
    while (!isOver) {
      const { takenMs, image } = await Promise.race([next, over]);
      if (isOver) break;
      next = take(takenMs); // taken while the face in this one is being found
      if (this.#isSlow && startMs !== null) {
        images.push({ takenMs, image });
      } else {
        const beginMs = performance.now();
        const landmarks = await Promise.race([tracker.find(image), over]);
        if (isOver) break;
        this.#numSlow = performance.now() > beginMs + SLOW_MS ? this.#numSlow + 1 : 0;
        drawLips(video, tracker.lips, landmarks);
        if (startMs === null && landmarks !== null) {
          startMs = performance.now();
          capture(context, stream, (chunk, rms, recordedMs) => recording.addSound(recordedMs, chunk, rms));
        }
        if (startMs !== null) recording.addFace(takenMs, landmarks);
      }
      if (startMs !== null) {
        numImages++;
        const sinceMs = performance.now() - startMs;
        const minImages = (FaceRecording.minRateHz * sinceMs) / 1000 / 2; // slower at first
        if (!isRateChecked && sinceMs > CLOSED_LIPS_MS && numImages < minImages) {
          throw new UserError(translate("tooSlow"));
        }
        isRateChecked ||= sinceMs > CLOSED_LIPS_MS;
      }
      this.#showTime(startMs, recording);
    }
    return images;
  }

  /** Find the faces in images that were not analyzed during the reading. */
  async #findFaces(images, recording, tracker, signal) {
    if (images.length > 0 && !signal.aborted) this.#show("learning");
    for (const [index, { takenMs, image }] of images.entries()) {
      if (signal.aborted) return;
      const percent = Math.floor((100 * index) / images.length);
      element("learn-progress").textContent = translate("learnTracking", { percent });
      recording.addFace(takenMs, await tracker.find(image));
    }
  }

  #showTime(startMs, recording) {
    const nowMs = performance.now();
    if (startMs === null) {
      element("learn-advice").textContent = translate("learnShowFace");
      return;
    }
    const readingMs = nowMs - startMs - CLOSED_LIPS_MS;
    const totalMs = 1000 * this.readingS * (this.#isSlow ? SLOW_FACTOR : 1);
    const remainingS = Math.ceil((readingMs < 0 ? -readingMs : totalMs - readingMs) / 1000);
    element("learn-count").textContent = remainingS;
    element("learn-time").value = Math.max(0, readingMs / totalMs);
    element("learn-reading").classList.toggle("due", readingMs >= 0);
    element("learn-finish").disabled = readingMs < MIN_READING * totalMs;
    const advice = recording.advice(nowMs) ?? (readingMs < 0 ? "learnLipsClosed" : "learnRead");
    element("learn-advice").textContent = translate(advice);
    if (remainingS <= 0) this.#finish();
  }

  // --- learning ----------------------------------------------------------------------------------

  async #learn() {
    this.#abort = new AbortController();
    const { signal } = this.#abort;
    element("learn-progress").textContent = translate("learnProgress");
    this.#show("learning");
    let answer = null;
    let problem = "";
    try {
      const response = await fetch(pathWithToken("learn-mouth"), { method: "POST", body: this.#recording, signal });
      if (response.ok) answer = await response.json();
      else problem = await translateResponse(response);
    } catch {
      problem = translate("gatewaySilent");
    }
    if (signal.aborted) return;
    if (answer === null) {
      this.#fail(problem);
      return;
    }
    const { mouth_profile: profile, before, after } = answer;
    this.#learned = { profile, learnedOn: Date.now(), before, after };
    this.#recording = null;
    this.#showResult(answer);
  }

  #showResult({ before, after, curves }) {
    element("learn-verdict").textContent = translate(verdict({ before, after }));
    const rows = correlationRows({ before, after }).map((cells) => {
      const row = document.createElement("tr");
      row.append(...cells.map((text, index) => (index === 0 ? cell("th", translate(text)) : cell("td", text))));
      return row;
    });
    element("learn-figures").replaceChildren(...rows);
    const box = { ...BOX, ...extent(...CURVES.map((name) => curves.opening[name])) };
    for (const name of CURVES) {
      const path = curvePath(curves.time_s, curves.opening[name], box);
      element(`learn-${name}`).setAttribute("d", path);
    }
    this.#show("result");
  }

  #keep(profile) {
    this.#profiles.keep(profile);
    this.#handlers.profileChanged();
    dialog.close();
  }
}

/**
 * Wait for the video's next image, `everyMs` after the previous one or later, and scale it to a width.
 * Return it and when it was taken, on the page's clock.
 */
async function nextImage(video, { previousMs = -Infinity, everyMs = 0, widthPx }) {
  const waitMs = previousMs + everyMs - performance.now();
  if (waitMs > 0) await new Promise((resolve) => setTimeout(resolve, waitMs));
  const takenMs = await new Promise((resolve) => {
    video.requestVideoFrameCallback((nowMs, { captureTime }) => resolve(captureTime ?? nowMs));
  });
  return { takenMs, image: await createImageBitmap(video, { resizeWidth: widthPx }) };
}

function errorText(error) {
  return CAMERA_ERRORS[error.name] ? translate(CAMERA_ERRORS[error.name]) : error.message;
}

function drawLips(video, lips, landmarks) {
  const canvas = element("learn-lips");
  canvas.width = video.videoWidth; // this also clears it
  canvas.height = video.videoHeight;
  if (landmarks === null) return;
  const context = canvas.getContext("2d");
  context.strokeStyle = getComputedStyle(canvas).color;
  context.lineWidth = (1.5 * canvas.width) / canvas.clientWidth;
  for (const [from, to] of lips) {
    context.moveTo(landmarks[3 * from], landmarks[3 * from + 1]);
    context.lineTo(landmarks[3 * to], landmarks[3 * to + 1]);
  }
  context.stroke();
}

function cell(tag, text) {
  return Object.assign(document.createElement(tag), { textContent: text });
}
