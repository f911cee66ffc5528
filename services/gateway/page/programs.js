// The panel of other programs that show the face: what is sent to each, and buttons to stop, start and delay.

import { pathOf } from "./address.js";
import { element, setText } from "./elements.js";
import { say } from "./language.js";
import { tens } from "./status.js";

const PERIOD_MS = 1000; // while the panel is open

const FITS_MS = 15; // a delay that is as near is not worth a change

/** Return the words for what a sender does: { contents, rate_hz, delay_ms, problem } of the gateway. */
export function senderText({ contents, rate_hz: rateHz, delay_ms: delayMs, problem }) {
  if (problem !== "") return problem;
  const later = delayMs === 0 ? { en: "", zh: "" } : { en: `, ${delayMs} ms later`, zh: `，延迟 ${delayMs} ms` };
  return say({
    en: `${contents}, ${Math.round(rateHz)} frames/s${later.en}`,
    zh: `${contents}，每秒 ${Math.round(rateHz)} 帧${later.zh}`,
  });
}

/** Return whether a sender is not as late as the picture on this page, whose frames wait so long; ms, null: unknown. */
export function isOff(senders, waitMs) {
  return waitMs !== null && senders.some(({ delay_ms: delayMs }) => Math.abs(delayMs - waitMs) > FITS_MS);
}

export class Programs {
  #timer = null;
  #senders = [];
  #waitMs = null;

  /** @param panel the popover that shows them */
  constructor(panel) {
    panel.addEventListener("toggle", ({ newState }) => {
      clearInterval(this.#timer);
      if (newState !== "open") return;
      this.#timer = setInterval(() => this.#ask(), PERIOD_MS);
      this.#ask();
    });
    element("send").onsubmit = async (event) => {
      event.preventDefault();
      const input = element("send-to");
      if (await this.#change({ start: input.value.trim() || input.placeholder })) input.value = "";
    };
    element("programs").onclick = ({ target }) => {
      const { start, stop } = target.dataset;
      if (start) this.#change({ start });
      if (stop) this.#change({ stop });
    };
    element("send-delay").onclick = () => this.#change({ delay_ms: this.#waitMs });
  }

  /** Say how long a frame waits until its picture is seen, in step with sound, ms; null: there is no sound. */
  set waitMs(ms) {
    this.#waitMs = ms === null ? null : Math.max(0, tens(ms)); // a frame that is late cannot be earlier
    this.#offerDelay();
  }

  #offerDelay() {
    const button = element("send-delay");
    button.hidden = !isOff(this.#senders, this.#waitMs);
    if (button.hidden) return;
    setText(button, say({ en: `Delay them by ${this.#waitMs} ms to fit this sound`, zh: `延迟 ${this.#waitMs} ms 以配合此声音` }));
  }

  #show(answer) {
    this.#senders = answer.senders;
    this.#offerDelay();
    show(answer);
  }

  async #ask() {
    const answer = await fetch(pathOf("senders")).catch(() => null);
    if (answer?.ok) this.#show(await answer.json());
  }

  /** Start or stop one; return whether that was done. */
  async #change(command) {
    const answer = await fetch(pathOf("senders"), { method: "POST", body: JSON.stringify(command) }).catch(() => null);
    if (answer === null) return false; // the page says that the gateway stopped
    const found = await answer.json();
    setText(element("send-problem"), found.error ?? "");
    if (answer.ok) this.#show(found);
    return answer.ok;
  }
}

function show({ senders, stopped }) {
  const rows = [
    ...senders.map((sender) => [sender.target, senderText(sender), "stop", { en: "Stop", zh: "停止" }]),
    ...stopped.map((url) => [url, "", "start", { en: "Start", zh: "开始" }]),
  ];
  const list = element("programs");
  while (list.children.length > rows.length) list.lastChild.remove();
  rows.forEach(([url, text, action, texts], index) => {
    const item = list.children[index] ?? list.appendChild(makeRow());
    const [name, about, button] = item.children;
    setText(name, url);
    setText(about, text);
    setText(button, say(texts));
    if (button.dataset[action] === url) return;
    for (const each of Object.keys(button.dataset)) delete button.dataset[each];
    button.dataset[action] = url;
  });
}

function makeRow() {
  const item = document.createElement("li");
  const button = Object.assign(document.createElement("button"), { type: "button" });
  item.append(document.createElement("b"), document.createElement("span"), button);
  return item;
}
