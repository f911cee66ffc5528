// The page's language, English or Chinese: that of the browser, unless another is chosen.

const ATTRIBUTES = ["title", "aria-label"]; // data-zh-title beside title, and so on

let isChinese = false;

/** Return "zh" or "en", for a browser's languages in the order in which its user likes them. */
export function languageFor(preferred) {
  const known = preferred.map((tag) => tag.slice(0, 2).toLowerCase());
  return known.find((name) => name === "zh" || name === "en") ?? "en";
}

/** Return that of two texts that is in the page's language. */
export function say({ en, zh }) {
  return isChinese ? zh : en;
}

/** Speak a language from here on; the style sheet shows its share of the document. */
export function setLanguage(name, page = document) {
  isChinese = name === "zh";
  page.documentElement.lang = name;
  for (const attribute of ATTRIBUTES) {
    for (const element of page.querySelectorAll(`[data-zh-${attribute}]`)) {
      const english = `data-en-${attribute}`;
      if (!element.hasAttribute(english)) {
        element.setAttribute(english, element.getAttribute(attribute));
      }
      element.setAttribute(attribute, element.getAttribute(`data-${name}-${attribute}`));
    }
  }
}
