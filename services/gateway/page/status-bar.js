// The status line: whether the face is live, its delay, and hints about problems.

import { isThisComputer } from "./address.js";
import { element, setText } from "./elements.js";
import { translate } from "./language.js";
import { PersistentFault } from "./notice.js";
import { delayText, hintText, playoutDelaysText, secondsText } from "./status-texts.js";

const LIGHT_LANGUAGE = "zh"; // the only language of the light acoustic model

/**
 * Return the state, a key of TEXTS. The state also sets the color of the status light.
 * isInterrupted: this page's microphone should be live.
 */
export function stateKey({ isConnected, isStarting, isLive, isBehind, isInterrupted }) {
  if (!isConnected) return isStarting ? "connecting" : "disconnected";
  if (isLive) return isBehind ? "behind" : "live";
  return isInterrupted ? "interrupted" : "waiting";
}

export class StatusBar {
  #parts;
  #wasLive = false; // in the session that is shown
  #fault = new PersistentFault();
  #sourceFault = new PersistentFault(); // of the microphone or the file

  /** @param parts { gateway, player, speech, sound, notice, senders }: sources of the state */
  constructor(parts) {
    this.#parts = parts;
  }

  /** Start again for another session. */
  reset() {
    this.#wasLive = false;
  }

  show() {
    const { gateway, player } = this.#parts;
    const nowMs = performance.now();
    const isLive = gateway.isConnected && player.activity.isLive(nowMs);
    this.#wasLive ||= isLive;
    player.lateness.update(nowMs, isLive && gateway.session !== null);
    const isBehind = isLive && player.lateness.isBehind;
    this.#showState(isLive, isBehind);
    this.#showDelays(isLive, isBehind);
    this.#showHints(nowMs);
  }

  #showState(isLive, isBehind) {
    const { gateway, speech } = this.#parts;
    const { isConnected, isStarting, session } = gateway;
    const isStalled = this.#wasLive && session !== null && session === speech.session;
    const isInterrupted = isStalled || speech.state === "interrupted";
    const state = stateKey({ isConnected, isStarting, isLive, isBehind, isInterrupted });
    element("status").dataset.state = state;
    element("status").title = session === null ? "" : translate("sessionName", { name: session });
    setText(element("state"), translate(isBehind && isThisComputer() ? "behindBusy" : state));
    element("behind").hidden = !isBehind;
    const isLight = gateway.acoustic === "light";
    for (const name of ["light", "acoustic"]) element(name).hidden = !isLight;
    element("light-model").hidden = isLight || gateway.language !== LIGHT_LANGUAGE;
  }

  #showDelays(isLive, isBehind) {
    const { player, sound, senders } = this.#parts;
    const { playout, lateness, voiceToImageMs } = player;
    const isAudible = isLive && sound.state === "on";
    const soundMs = isAudible ? playout.delayMs : null;
    const frameMs = isAudible ? playout.frameWaitMs : null;
    const delay = isBehind ? secondsText(lateness.recentMs) : delayText(voiceToImageMs, soundMs);
    setText(element("delay"), isLive ? delay : "");
    setText(element("playout-delays"), playoutDelaysText(soundMs, frameMs));
    senders.frameWaitMs = frameMs;
  }

  /** Show a hint about a fault of the system or of the microphone, and a toast when it is over. */
  #showHints(nowMs) {
    const { gateway, speech, notice } = this.#parts;
    const { isFile } = speech.microphone;
    const fault = this.#fault.update(nowMs, hintText(gateway));
    const interruption = translate(isFile ? "fileInterrupted" : "microphoneInterrupted");
    const source = this.#sourceFault.update(nowMs, speech.state === "interrupted" ? interruption : "");
    if (fault.isOver) notice.showToast(translate("recovered"), "hint");
    if (source.isOver && speech.state === "on") {
      notice.showToast(translate(isFile ? "fileResumed" : "microphoneResumed"), "hint");
    }
    notice.showHint(fault.hint || source.hint);
  }
}
