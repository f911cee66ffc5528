// Contrast of the style sheet's colors in both themes, by WCAG 2.2 AA. Panels are translucent and cover
// an image of any color.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import test from "node:test";

const [TEXT, GRAPHICS] = [4.5, 3]; // minimum contrast (1.4.3, 1.4.11)
const STYLE = readFileSync(new URL("../../services/gateway/page/style.css", import.meta.url), "utf8");
const COLOR = String.raw`#[0-9a-f]{3,6}|rgb\([^)]*\)`;

/** Return a theme's colors by name: { rgb, share: opacity }. */
function theme(which) {
  const [light, dark] = STYLE.split("prefers-color-scheme: dark");
  const pattern = new RegExp(`--([a-z-]+): (${COLOR});`, "g");
  const matches = [...(which === "light" ? light : light + dark).matchAll(pattern)]; // later values win
  return Object.fromEntries(matches.map(([, name, color]) => [name, read(color)]));
}

function read(color) {
  if (color.startsWith("rgb")) {
    const [red, green, blue, percent] = color.match(/\d+/g).map(Number);
    return { rgb: [red, green, blue], share: percent / 100 };
  }
  const digits = color.length === 4 ? color.replace(/[0-9a-f]/g, "$&$&") : color;
  return { rgb: [1, 3, 5].map((at) => parseInt(digits.slice(at, at + 2), 16)), share: 1 };
}

function over({ rgb, share }, below) {
  return { rgb: rgb.map((value, i) => share * value + (1 - share) * below.rgb[i]), share: 1 };
}

function luminance({ rgb }) {
  const [red, green, blue] = rgb.map((value) => {
    const level = value / 255;
    return level <= 0.04045 ? level / 12.92 : ((level + 0.055) / 1.055) ** 2.4;
  });
  return 0.2126 * red + 0.7152 * green + 0.0722 * blue;
}

function checkContrast(one, other, min) {
  const [low, high] = [luminance(one), luminance(other)].sort((a, b) => a - b);
  const ratio = (high + 0.05) / (low + 0.05);
  assert.ok(ratio >= min, `${one.rgb} on ${other.rgb}: ${ratio.toFixed(2)}`);
}

const [BLACK, WHITE] = [read("#000"), read("#fff")];

for (const which of ["light", "dark"]) {
  test(`colors have contrast in the ${which} theme`, () => {
    const colors = theme(which);
    const { panel, sheet, line, accent, good, busy, bad } = colors;
    const panels = [BLACK, WHITE].map((picture) => over(panel, picture));
    const grounds = [colors["back-center"], colors["back-edge"], sheet, over(line, sheet), ...panels];
    for (const ground of grounds) {
      for (const name of ["ink", "faint"]) checkContrast(colors[name], ground, TEXT);
    }
    checkContrast(WHITE, accent, TEXT);
    const below = over(panel, colors["back-edge"]); // the status light is near the edge
    for (const light of [good, busy, bad]) checkContrast(light, below, GRAPHICS);
  });
}
