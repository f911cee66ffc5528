// Texts about the page's state.

import { say } from "./language.js";
import { TEXTS } from "./texts.js";

/** Return the kind of state, which colors the status light: "lost", "waiting" or "live". */
export function stateKind({ isConnected, isLive }) {
  if (!isConnected) return "lost";
  return isLive ? "live" : "waiting";
}

/** Return the text of the state. isInterrupted: our microphone should be live. */
export function stateText({ isConnected, isLive, isInterrupted }) {
  if (!isConnected) return say("connecting");
  if (isLive) return say("live");
  return say(isInterrupted ? "interrupted" : "waiting");
}

/**
 * Return the text of the delay from the user's voice to the image, else of the sound's delay; ""
 * while both are unknown (null).
 */
export function delayText(voiceMs, soundMs) {
  if (voiceMs !== null) return `${roundToTens(voiceMs)} ms`;
  return soundMs === null ? "" : say("soundDelay", { ms: roundToTens(soundMs) });
}

/** Return the text of the delays of sound and of frames until their image; "" while unknown. */
export function playoutDelaysText(soundMs, frameMs) {
  if (soundMs === null || frameMs === null) return "";
  const [sound, frame] = [soundMs, frameMs].map(roundToTens);
  return say("playoutDelays", { soundMs: sound, frameMs: frame });
}

/** Round to tens: nobody sees a few milliseconds, and the text changes less often. */
export function roundToTens(ms) {
  return Math.round(ms / 10) * 10;
}

/** Return the text about reduced quality (Head.drawing); "" if the quality is full. */
export function drawingText({ isCoarse, width, height }) {
  return isCoarse ? say("drawnInSoftware", { size: `${width} × ${height}` }) : "";
}

/** Return the text of the head's rotation in the picture, degrees. */
export function turnText(turned) {
  const [left, up] = [turned.left, turned.up].map(Math.round);
  if (left === 0 && up === 0) return say("turnedFront");
  const directions = [
    [left, "turnedLeft"],
    [-left, "turnedRight"],
    [up, "turnedUp"],
    [-up, "turnedDown"],
  ]
    .filter(([degrees]) => degrees > 0)
    .map(([degrees, key]) => say(key, { degrees }));
  return say("turned", { directions: directions.join(", ") });
}

/** Return what does not work and what to do; "" if all is well. */
export function hintText({ isConnected, wasConnected, isRefused, isMicrophoneInterrupted, missing }) {
  if (!isConnected && wasConnected) return say("gatewayStopped");
  if (isRefused) return say("connectionRefused");
  if (isConnected && missing.includes("control")) return say("controlMissing");
  if (isConnected && missing.length > 0) {
    return say("servicesMissing", {
      services: missing.join(", "),
      commands: missing.map((name) => `kouxing ${name}`).join("; "),
    });
  }
  return isMicrophoneInterrupted ? say("microphoneInterrupted") : "";
}

/** Return the text of the gateway's error message. */
export function errorText({ code, text }) {
  return TEXTS[`error.${code}`] === undefined ? text : say(`error.${code}`, { text });
}
