// The settings panel: head, lips, size of movements, expressions and language.

import { element } from "./elements.js";
import { addTexts, languageFor, translate, setLanguage } from "./language.js";
import { TEXTS } from "./texts.js";

const EXPRESSION_STRENGTH = 0.8;
const SLIDERS = ["expressiveness", "feeling"];
export const FACE_SETTINGS = [...SLIDERS, "still", "eye_contact"]; // also their names in messages
const EXPRESSIONS = ["smile", "joy", "surprise", "sadness", "anger", "fear", "disgust"];

/** Return the language that the user has chosen, or the browser's. */
export function preferredLanguage(preferences) {
  return preferences.get("language") ?? languageFor(navigator.languages);
}

export class Settings {
  #preferences;
  #offers;

  /**
   * @param preferences Preferences
   * @param offers { heads: names, lips: { name: title by language }, languages: { code: title by
   *   language } } of the gateway
   * @param handlers { heads(name), lipModel(name), speechLanguage(code), faceSettings(), expressions(strengths by name) },
   *   called when the user changes a setting
   */
  constructor(preferences, offers, handlers) {
    this.#preferences = preferences;
    const order = Object.keys(TEXTS);
    const heads = [...offers.heads].sort((a, b) => order.indexOf(`head.${a}`) - order.indexOf(`head.${b}`));
    this.#offers = { ...offers, heads };
    addTexts("lips", offers.lips);
    addTexts("speech", offers.languages);
    this.#applyLanguage();
    this.#bind("heads", handlers.heads);
    this.#bind("lips", handlers.lipModel);
    this.#bind("speech-language", handlers.speechLanguage);
    for (const id of FACE_SETTINGS) this.#bind(id, handlers.faceSettings);
    for (const id of SLIDERS) {
      element(id).addEventListener("input", () => showAmount(id));
      showAmount(id);
    }
    this.#bind("language", () => this.#applyLanguage());
    element("expressions").onclick = ({ target }) => {
      if (target.value) handlers.expressions({ [target.value]: EXPRESSION_STRENGTH });
    };
  }

  /** Select the lip model that is in use. */
  showLipModel(name) {
    element("lips").value = name;
  }

  /** Show the sizes of a session's face, by the ids of the sliders, unless the user has chosen others. */
  showSizes(sizes) {
    for (const id of SLIDERS) {
      if (sizes[id] === null || this.#preferences.get(id) !== null) continue;
      element(id).value = sizes[id];
      showAmount(id);
    }
  }

  /** Connect an input with its preference. A stored value that is no longer offered is ignored. */
  #bind(id, onChange) {
    const input = element(id);
    const [initial, stored] = [input.value, this.#preferences.get(id)];
    if (stored !== null) input[input.type === "checkbox" ? "checked" : "value"] = stored;
    if (input.selectedIndex === -1) input.value = initial;
    input.addEventListener("input", () => {
      const value = { range: input.valueAsNumber, checkbox: input.checked }[input.type] ?? input.value;
      this.#preferences.set(id, value);
      onChange(value);
    });
  }

  #applyLanguage() {
    const name = preferredLanguage(this.#preferences);
    setLanguage(name);
    element("language").value = name;
    fill("heads", "option", "head", ["", ...this.#offers.heads]);
    showPictures(this.#offers.heads);
    fill("lips", "option", "lips", Object.keys(this.#offers.lips));
    fill("speech-language", "option", "speech", Object.keys(this.#offers.languages));
    fill("expressions", "button", "expression", EXPRESSIONS);
  }
}

/** Fill a list with options or buttons and keep the selection. */
function fill(id, tag, textPrefix, values) {
  const { value: selected } = element(id);
  const items = values.map((value) => {
    const item = document.createElement(tag);
    if (tag === "button") item.type = "button";
    item.value = value;
    item.textContent = translate(`${textPrefix}.${value}`);
    return item;
  });
  element(id).replaceChildren(...items);
  if (selected) element(id).value = selected;
}

/** Show a picture of each head. A click on it selects the head in the list. */
function showPictures(names) {
  const heads = element("heads");
  const buttons = names.map((name) => {
    const button = document.createElement("button");
    button.type = "button";
    const title = translate(`head.${name}`);
    button.title = title;
    button.append(Object.assign(new Image(48, 48), { src: `head-${name}.webp`, alt: title }));
    button.onclick = () => {
      heads.value = name;
      heads.dispatchEvent(new Event("input"));
    };
    return button;
  });
  element("head-pictures").replaceChildren(...buttons);
}

function showAmount(id) {
  const { valueAsNumber: amount } = element(id);
  element(`${id}-shown`).value = `${Math.round(100 * amount)} %`;
}
