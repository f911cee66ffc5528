// The panel of what can be chosen: head, lips, expressiveness, expressions, language.

import { element } from "./elements.js";
import { languageFor, say, setLanguage } from "./language.js";
import { EXPRESSIONS, HEADS, LIPS } from "./offers.js";

const STRENGTH = 0.8; // of an expression

export class Settings {
  #choices;

  /**
   * @param choices Choices
   * @param handlers { heads(name), lips(name), expressiveness(amount), express(strengths, by name) },
   *   called when something else is chosen
   */
  constructor(choices, handlers) {
    this.#choices = choices;
    this.#speak();
    const speak = () => this.#speak();
    for (const [id, chosen] of Object.entries({ ...handlers, language: speak })) {
      if (id !== "express") this.#offer(id, chosen);
    }
    element("expressions").onclick = ({ target }) => {
      if (target.value) handlers.express({ [target.value]: STRENGTH });
    };
    element("expressiveness").addEventListener("input", showAmount);
    showAmount();
  }

  /** Show the lip model that moves the mouth at the moment. */
  showLips(name) {
    element("lips").value = name;
  }

  /** Let an input choose, beginning with what was chosen before, if that is still offered. */
  #offer(id, chosen) {
    const input = element(id);
    const [usual, before] = [input.value, this.#choices.get(id)];
    if (before !== null) input.value = before;
    if (input.selectedIndex === -1) input.value = usual;
    input.addEventListener("input", () => {
      const value = input.type === "range" ? input.valueAsNumber : input.value;
      this.#choices.set(id, value);
      chosen(value);
    });
  }

  #speak() {
    const name = this.#choices.get("language") ?? languageFor(navigator.languages);
    setLanguage(name);
    element("language").value = name;
    fill("heads", HEADS, "option");
    showPictures();
    fill("lips", LIPS, "option");
    fill("expressions", EXPRESSIONS, "button");
  }
}

/** Offer values, [value, texts], as elements of a kind; what is chosen stays so. */
function fill(id, values, kind) {
  const { value: chosen } = element(id);
  const offers = values.map(([value, texts]) => {
    const offer = document.createElement(kind);
    if (kind === "button") offer.type = "button";
    offer.value = value;
    offer.textContent = say(texts);
    return offer;
  });
  element(id).replaceChildren(...offers);
  if (chosen) element(id).value = chosen;
}

/** Let a picture choose each head that has one, as its name in the list does. */
function showPictures() {
  const heads = element("heads");
  const pictures = HEADS.filter(([name]) => name !== "").map(([name, texts]) => {
    const button = document.createElement("button");
    button.type = "button";
    button.title = say(texts);
    button.append(Object.assign(new Image(48, 48), { src: `head-${name}.webp`, alt: say(texts) }));
    button.onclick = () => {
      heads.value = name;
      heads.dispatchEvent(new Event("input"));
    };
    return button;
  });
  element("head-pictures").replaceChildren(...pictures);
}

function showAmount() {
  const { valueAsNumber: amount } = element("expressiveness");
  element("expressiveness-shown").value = `${Math.round(100 * amount)} %`;
}
