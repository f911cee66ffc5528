// The page's state: texts, the status line, the sound level, notices, and hints about problems.

import { isThisComputer } from "./address.js";
import { element, setText } from "./elements.js";
import { translate } from "./language.js";
import { SILENT_DB } from "./level.js";

const TOAST_MS = 8000; // how long a toast is shown
const SHOWN_AFTER_MS = 1000; // shorter faults are not shown

/** The state that the gateway reports: the connection, the session that is shown, missing services. */
export class GatewayState {
  isConnected = false;
  wasConnected = false;
  session = null; // name of the session that is shown
  epoch = 0; // epoch of the session; it increases with each restart
  isSample = false; // whether the session is the sample sentence that this page asked for
  lipModel = null; // lip model of the session; null: unknown
  acoustic = ""; // acoustic model of the session: full or light
  missing = []; // services that are not running

  /** Whether the gateway rejected the first connection, although it served this page. */
  isRefused = false;

  /** Whether the page is connecting for the first time. */
  get isStarting() {
    return !this.wasConnected && !this.isRefused;
  }

  setConnected(isConnected) {
    this.isConnected = isConnected;
    this.wasConnected ||= isConnected;
    this.isRefused = !this.wasConnected;
    if (!isConnected) this.session = null;
  }

  /** Process a "session" message; return { isRestart, isOther }: whether the epoch or session changed. */
  setSession({ session, epoch, sample, lip_model, acoustic }) {
    // A session whose epoch is lower is a new one with the name of an earlier one.
    const isOther = session !== this.session || epoch < this.epoch;
    const isRestart = !isOther && session !== null && epoch > this.epoch;
    this.session = session;
    this.epoch = epoch;
    this.isSample = sample;
    this.acoustic = acoustic;
    if (session !== null) this.lipModel = lip_model || null; // a session that has ended is still visible
    return { isOther, isRestart };
  }
}

/**
 * Return the state, a key of TEXTS. The state also sets the color of the status light.
 * isInterrupted: this page's microphone should be live.
 */
export function stateKey({ isConnected, isStarting, isLive, isBehind, isInterrupted }) {
  if (!isConnected) return isStarting ? "connecting" : "disconnected";
  if (isLive) return isBehind ? "behind" : "live";
  return isInterrupted ? "interrupted" : "waiting";
}

/**
 * Return the text of the delay from the user's voice to the image, else of the sound's delay; ""
 * while both are unknown (null).
 */
export function delayText(voiceMs, soundMs) {
  if (voiceMs !== null) return `${roundToTens(voiceMs)} ms`;
  return soundMs === null ? "" : translate("soundDelay", { ms: roundToTens(soundMs) });
}

/** Return the text of a delay in seconds, with tenths: more digits would change too often. */
export function secondsText(ms) {
  return translate("seconds", { seconds: (ms / 1000).toFixed(1) });
}

/** Return the text of the delays of sound and of frames until their image; "" while unknown. */
export function playoutDelaysText(soundMs, frameMs) {
  if (soundMs === null || frameMs === null) return "";
  const [sound, frame] = [soundMs, frameMs].map(roundToTens);
  return translate("playoutDelays", { soundMs: sound, frameMs: frame });
}

/** Round to tens: a few milliseconds are invisible, and the text changes less often. */
export function roundToTens(ms) {
  return Math.round(ms / 10) * 10;
}

/** Return the text about reduced quality (Head.drawing); "" if the quality is full. */
export function drawingText({ isCoarse, width, height }) {
  return isCoarse ? translate("drawnInSoftware", { size: `${width} × ${height}` }) : "";
}

/** Return the text of the head's rotation in the picture, degrees. */
export function turnText(turned) {
  const [left, up] = [turned.left, turned.up].map(Math.round);
  if (left === 0 && up === 0) return translate("turnedFront");
  const directions = [
    [left, "turnedLeft"],
    [-left, "turnedRight"],
    [up, "turnedUp"],
    [-up, "turnedDown"],
  ]
    .filter(([degrees]) => degrees > 0)
    .map(([degrees, key]) => translate(key, { degrees }));
  return translate("turned", { directions: directions.join(", ") });
}

/** Return what does not work and what to do; "" if all is well. */
export function hintText({ isConnected, wasConnected, isRefused, missing }) {
  if (!isConnected && wasConnected) return translate("gatewayStopped");
  if (isRefused) return translate("connectionRefused");
  if (isConnected && missing.includes("control")) return translate("controlMissing");
  if (isConnected && missing.length > 0) {
    return translate("servicesMissing", {
      services: missing.join(", "),
      commands: missing.map((name) => `kouxing ${name}`).join("; "),
    });
  }
  return "";
}

/** Shows the hint of a fault only if the fault lasts, and reports its end. Time is injected. */
export class PersistentFault {
  #sinceMs = null;
  #isShown = false;

  /** Take the current hint, "" without a fault; return { hint: to be shown, isOver }. */
  update(nowMs, hint) {
    if (hint === "") {
      const isOver = this.#isShown;
      this.#sinceMs = null;
      this.#isShown = false;
      return { hint, isOver };
    }
    this.#sinceMs ??= nowMs;
    this.#isShown ||= nowMs - this.#sinceMs > SHOWN_AFTER_MS;
    return { hint: this.#isShown ? hint : "", isOver: false };
  }
}

export class StatusBar {
  #parts;
  #wasLive = false; // in the session that is shown
  #fault = new PersistentFault();
  #microphoneFault = new PersistentFault();

  /** @param parts { gateway, player, speech, sound, notice, senders }: sources of the state */
  constructor(parts) {
    this.#parts = parts;
  }

  /** Start again for another session. */
  reset() {
    this.#wasLive = false;
  }

  show() {
    const { gateway, player, speech, sound, notice, senders } = this.#parts;
    const { isConnected, isStarting, session } = gateway;
    const nowMs = performance.now();
    const isLive = isConnected && player.activity.isLive(nowMs);
    this.#wasLive ||= isLive;
    const isMicrophoneInterrupted = speech.state === "interrupted";
    const isStalled = this.#wasLive && session !== null && session === speech.session;
    const isInterrupted = isMicrophoneInterrupted || isStalled;
    player.lateness.update(nowMs, isLive && session !== null);
    const isBehind = isLive && player.lateness.isBehind;
    const state = stateKey({ isConnected, isStarting, isLive, isBehind, isInterrupted });
    element("status").dataset.state = state;
    element("status").title = session === null ? "" : translate("sessionName", { name: session });
    setText(element("state"), translate(isBehind && isThisComputer() ? "behindBusy" : state));
    element("behind").hidden = !isBehind;
    const isLight = gateway.acoustic === "light";
    for (const name of ["light", "acoustic"]) element(name).hidden = !isLight;
    element("light-model").hidden = isLight;

    const { playout, voiceToImageMs } = player;
    const isAudible = isLive && sound.state === "on";
    const soundMs = isAudible ? playout.delayMs : null;
    const frameMs = isAudible ? playout.frameWaitMs : null;
    const delay = isBehind ? secondsText(player.lateness.recentMs) : delayText(voiceToImageMs, soundMs);
    setText(element("delay"), isLive ? delay : "");
    setText(element("playout-delays"), playoutDelaysText(soundMs, frameMs));
    senders.frameWaitMs = frameMs;
    const fault = this.#fault.update(nowMs, hintText(gateway));
    const pause = isMicrophoneInterrupted ? translate("microphoneInterrupted") : "";
    const microphone = this.#microphoneFault.update(nowMs, pause);
    if (fault.isOver) notice.showToast(translate("recovered"), "hint");
    if (microphone.isOver && speech.state === "on") notice.showToast(translate("microphoneResumed"), "hint");
    notice.showHint(fault.hint || microphone.hint);
  }
}

/** Show a level on the meter, dB of full scale. */
export function showLevel(decibels) {
  const level = (1 - decibels / SILENT_DB).toFixed(3);
  element("meter").firstElementChild.style.transform = `scaleX(${level})`;
  element("meter").setAttribute("aria-valuenow", Math.round(decibels));
}

/** The notice at the top: for some seconds a toast, otherwise a hint about a lasting problem. */
export class Notice {
  #toastTimer = null;

  /** Show a toast, in the color of an "error" or a "hint". */
  showToast(text, kind) {
    clearTimeout(this.#toastTimer);
    this.#toastTimer = setTimeout(() => (this.#toastTimer = null), TOAST_MS);
    showNotice(text, kind);
  }

  /** Remove the toast. */
  clear() {
    clearTimeout(this.#toastTimer);
    this.#toastTimer = null;
    this.showHint("");
  }

  /** Show a hint unless a toast is shown; "" shows no hint. */
  showHint(text) {
    if (this.#toastTimer === null) showNotice(text, "hint");
  }
}

function showNotice(text, kind) {
  const box = element("notice");
  box.dataset.kind = kind;
  box.hidden = text === "";
  setText(box, text);
}
