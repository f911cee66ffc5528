// The panel of senders: other programs that show the face. It lists them with buttons to start, stop
// and delay them.

import { pathWithToken } from "./address.js";
import { element, setText } from "./elements.js";
import { translate, translateReceived, translateResponse } from "./language.js";
import { roundToTens } from "./status-texts.js";

const PERIOD_MS = 1000; // while the panel is open
const TOLERANCE_MS = 15; // smaller differences of delays are ignored

/** Return the text of a sender's state: { contents, rate_hz, delay_ms, problem } of the gateway. */
export function senderText({ contents, rate_hz: rateHz, delay_ms: delay, problem }) {
  if (problem !== "") return translateReceived(problem);
  const values = { contents: translateReceived(contents), rate: Math.round(rateHz), delay };
  return translate(delay === 0 ? "senderState" : "senderStateDelayed", values);
}

/** Return whether a sender's delay differs from this page's, ms; null: the page has no sound. */
export function isOutOfSync(senders, frameWaitMs) {
  return (
    frameWaitMs !== null &&
    senders.some(({ delay_ms: delayMs }) => Math.abs(delayMs - frameWaitMs) > TOLERANCE_MS)
  );
}

export class SendersPanel {
  #timer = null;
  #senders = [];
  #frameWaitMs = null;

  /** @param panel the popover that contains it */
  constructor(panel) {
    panel.addEventListener("toggle", ({ newState }) => {
      clearInterval(this.#timer);
      if (newState !== "open") return;
      this.#timer = setInterval(() => this.#refresh(), PERIOD_MS);
      this.#refresh();
    });
    element("send").onsubmit = async (event) => {
      event.preventDefault();
      const input = element("send-to");
      if (await this.#post({ start: input.value.trim() || input.placeholder })) input.value = "";
    };
    element("senders").onclick = ({ target }) => {
      const { start, stop } = target.dataset;
      if (start) this.#post({ start });
      if (stop) this.#post({ stop });
    };
    element("send-delay").onclick = () => this.#post({ delay_ms: this.#frameWaitMs });
  }

  /** Set how long a frame waits for its image while sound is played, ms; null without sound. */
  set frameWaitMs(ms) {
    this.#frameWaitMs = ms === null ? null : Math.max(0, roundToTens(ms)); // a sender cannot be early
    this.#offerDelay();
  }

  #offerDelay() {
    const button = element("send-delay");
    button.hidden = !isOutOfSync(this.#senders, this.#frameWaitMs);
    if (!button.hidden) setText(button, translate("delaySenders", { ms: this.#frameWaitMs }));
  }

  #show(answer) {
    this.#senders = answer.senders;
    this.#offerDelay();
    showRows(answer);
  }

  async #refresh() {
    const response = await fetch(pathWithToken("senders")).catch(() => null);
    if (response?.ok) this.#show(await response.json());
  }

  /** Send a command; return whether it succeeded. */
  async #post(command) {
    const options = { method: "POST", body: JSON.stringify(command) };
    const response = await fetch(pathWithToken("senders"), options).catch(() => null);
    if (response === null) return false; // the notice reports that the gateway does not answer
    setText(element("send-problem"), response.ok ? "" : await translateResponse(response));
    if (response.ok) this.#show(await response.json());
    return response.ok;
  }
}

function showRows({ senders, stopped }) {
  const rows = [
    ...senders.map((sender) => [sender.target, senderText(sender), "stop"]),
    ...stopped.map((url) => [url, "", "start"]),
  ];
  const list = element("senders");
  while (list.children.length > rows.length) list.lastChild.remove();
  rows.forEach(([url, state, action], index) => {
    const item = list.children[index] ?? list.appendChild(makeRow());
    const [name, about, button] = item.children;
    setText(name, url);
    setText(about, state);
    setText(button, translate(action));
    delete button.dataset[action === "stop" ? "start" : "stop"];
    button.dataset[action] = url;
  });
}

function makeRow() {
  const item = document.createElement("li");
  const button = Object.assign(document.createElement("button"), { type: "button" });
  item.append(document.createElement("b"), document.createElement("span"), button);
  return item;
}
