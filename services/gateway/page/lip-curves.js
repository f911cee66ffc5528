// What was learnt, for people: curves and words. Pure code: nothing is drawn.

const MEASURES = [
  ["opening", { en: "Opening", zh: "张口" }],
  ["width", { en: "Width", zh: "宽度" }],
  ["jaw", { en: "Jaw", zh: "下颌" }],
];
const NOTEWORTHY = 0.02; // a difference of correlations
const POOR = 0.2; // a correlation
const GAP_S = 0.1; // between two values that no line joins

const BETTER = {
  en: "The head's lips now follow yours more closely.",
  zh: "现在头像的口型更像你了。",
};
const SAME = {
  en: "The head's lips follow yours about as well as before.",
  zh: "效果和以前差不多。",
};
const WORSE = {
  en:
    "The head's lips do not follow yours so: discard this and try again, with light on your face and " +
    "no other voices.",
  zh: "效果不好：建议放弃，换个光线好、安静的地方再试。",
};

/** Return an SVG path of a curve in a box; nothing is drawn where values are null or missing. */
export function curvePath(times, values, { width, height, low, high }) {
  const [first, last] = [times[0], times.at(-1)];
  let isDown = false; // the pen
  return times
    .map((time, index) => {
      const value = values[index];
      const step = isDown && time - times[index - 1] < GAP_S ? "L" : "M";
      isDown = value !== null;
      if (!isDown) return "";
      const x = (width * (time - first)) / (last - first || 1);
      const y = (height * (high - value)) / (high - low || 1);
      return `${step}${x.toFixed(1)} ${y.toFixed(1)}`;
    })
    .join("");
}

/** Return the least and the greatest value of curves; values may be null. */
export function extent(...curves) {
  const values = curves.flat().filter((value) => value !== null);
  return { low: Math.min(...values), high: Math.max(...values) };
}

/**
 * Return rows [measure, before, after] of how closely the lips follow the speaker's, 1 at best; the measure in
 * both languages.
 */
export function figures({ before, after }) {
  return MEASURES.map(([key, name]) => [name, figure(before[key]), figure(after[key])]);
}

function figure(correlation) {
  return typeof correlation === "number" ? correlation.toFixed(2) : "–";
}

/** Return what the figures mean, in both languages. */
export function verdict({ before, after }) {
  const gain = mean(after) - mean(before);
  if (mean(after) < POOR || gain < -NOTEWORTHY) return WORSE;
  return gain > NOTEWORTHY ? BETTER : SAME;
}

function mean(correlations) {
  const values = MEASURES.map(([key]) => correlations[key]).filter((value) => value !== null);
  return values.reduce((sum, value) => sum + value, 0) / values.length;
}
