// The page's language, English or Chinese. If none was chosen, it is the browser's.

import { errorToChinese, toChinese } from "./gateway-texts.js";
import { TEXTS } from "./texts.js";

const ATTRIBUTES = { title: "title", label: "aria-label" }; // by their data- attributes

let language = "en";

/** Add texts { en, zh } by name; their keys are `PREFIX.NAME`. */
export function addTexts(prefix, texts) {
  for (const [name, text] of Object.entries(texts)) TEXTS[`${prefix}.${name}`] = text;
}

/** An error whose message is a text for the user. */
export class UserError extends Error {}

/** Return "zh" or "en", for the languages that a browser's user prefers, in this order. */
export function languageFor(preferred) {
  const known = preferred.map((tag) => tag.slice(0, 2).toLowerCase());
  return known.find((name) => name === "zh" || name === "en") ?? "en";
}

/** Return a text of TEXTS with values. Without an entry, it is the part of the key after the last dot. */
export function translate(key, values = {}) {
  const text = TEXTS[key]?.[language] ?? key.split(".").at(-1);
  return text.replace(/\{(\w+)\}/g, (_, name) => values[name]);
}

/** Return a text of the gateway in the page's language. */
export function translateReceived(text) {
  return language === "zh" ? toChinese(text) : text;
}

/** Return the error of an HTTP response, which is JSON or text, in the page's language. */
export async function translateResponse(response) {
  const isJson = response.headers.get("Content-Type")?.startsWith("application/json");
  const text = isJson ? (await response.json()).error : await response.text();
  return translateReceived(text.trim());
}

/** Return the text of an error message in the page's language. */
export function translateError({ code, text }) {
  if (code === "bad-mouth-profile") return translate("oldMouthProfile");
  return language === "zh" ? errorToChinese(code, text) : text;
}

/** Set the page's language and translate all elements that name a text (data-text etc.). */
export function setLanguage(name, page = document) {
  language = name;
  page.documentElement.lang = name;
  for (const element of page.querySelectorAll("[data-text]")) {
    element.textContent = translate(element.dataset.text);
  }
  for (const [key, attribute] of Object.entries(ATTRIBUTES)) {
    for (const element of page.querySelectorAll(`[data-${key}]`)) {
      element.setAttribute(attribute, translate(element.dataset[key]));
    }
  }
}
