// The page's elements, by their names.

export function element(id) {
  return document.getElementById(id);
}

/** Show a text, if another is shown: what reads the screen aloud hears of each change. */
export function setText(target, text) {
  if (target.textContent !== text) target.textContent = text;
}
