// Texts about delays, the drawing, the head's rotation, and what does not work.

import { translate } from "./language.js";

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
export function hintText({ isConnected, wasConnected, isRejected, missing }) {
  if (isRejected) return translate("connectionRejected");
  if (!isConnected && wasConnected) return translate("gatewayLost");
  if (isConnected && missing.includes("control")) return translate("controlMissing");
  if (isConnected && missing.length > 0) {
    return translate("servicesMissing", {
      services: missing.join(", "),
      commands: missing.map((name) => `kouxing ${name}`).join("; "),
    });
  }
  return "";
}
