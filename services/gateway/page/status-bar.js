// Shows the page's state: the status line, the sound level, and hints about problems.

import { element, setText } from "./elements.js";
import { SILENT_DB } from "./level.js";
import { delayText, hintText, playoutDelaysText, stateKind, stateText } from "./status.js";

export class StatusBar {
  #gateway;
  #player;
  #speech;
  #sound;
  #notice;
  #senders;
  #wasLive = false; // in the session that is shown

  /** @param parts { gateway, player, speech, sound, notice, senders }: where the state is */
  constructor({ gateway, player, speech, sound, notice, senders }) {
    this.#gateway = gateway;
    this.#player = player;
    this.#speech = speech;
    this.#sound = sound;
    this.#notice = notice;
    this.#senders = senders;
  }

  /** Another session is shown. */
  reset() {
    this.#wasLive = false;
  }

  show() {
    const { isConnected, session } = this.#gateway;
    const isLive = isConnected && this.#player.isLive(performance.now());
    this.#wasLive ||= isLive;
    const isMicrophoneInterrupted = this.#speech.state === "interrupted";
    const isStalled = this.#wasLive && session !== null && session === this.#speech.session;
    const isInterrupted = isMicrophoneInterrupted || isStalled;
    element("status").dataset.state = stateKind({ isConnected, isLive });
    element("status").title = session === null ? "" : `session ${session}`;
    setText(element("state"), stateText({ isConnected, isLive, isInterrupted }));

    const { playout, voiceToImageMs } = this.#player;
    const isAudible = isLive && this.#sound.state === "on";
    const soundMs = isAudible ? playout.delayMs : null;
    const frameMs = isAudible ? playout.frameWaitMs : null;
    setText(element("delay"), isLive ? delayText(voiceToImageMs, soundMs) : "");
    setText(element("playout-delays"), playoutDelaysText(soundMs, frameMs));
    this.#senders.frameWaitMs = frameMs;
    this.#notice.showHint(hintText({ ...this.#gateway, isMicrophoneInterrupted }));
  }
}

/** Show a level on the meter, dB of full scale. */
export function showLevel(decibels) {
  const share = (1 - decibels / SILENT_DB).toFixed(3);
  element("meter").firstElementChild.style.transform = `scaleX(${share})`;
  element("meter").setAttribute("aria-valuenow", Math.round(decibels));
}
