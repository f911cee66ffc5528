// Curves and summaries of learned lips.

const MEASURES = ["opening", "width", "jaw"];
const MIN_GAIN = 0.02; // difference of correlations that counts as a change
const MIN_CORRELATION = 0.2;
const MAX_GAP_S = 0.1; // between two values that are joined by a line

/** Return the SVG path of a curve in a box, with gaps where values are null or missing. */
export function curvePath(times, values, { width, height, low, high }) {
  const [first, last] = [times[0], times.at(-1)];
  let isDrawing = false;
  return times
    .map((time, index) => {
      const value = values[index];
      const step = isDrawing && time - times[index - 1] < MAX_GAP_S ? "L" : "M";
      isDrawing = value !== null;
      if (!isDrawing) return "";
      const x = (width * (time - first)) / (last - first || 1);
      const y = (height * (high - value)) / (high - low || 1);
      return `${step}${x.toFixed(1)} ${y.toFixed(1)}`;
    })
    .join("");
}

/** Return the minimum and the maximum of all curves. Values may be null. */
export function extent(...curves) {
  const values = curves.flat().filter((value) => value !== null);
  return { low: Math.min(...values), high: Math.max(...values) };
}

/** Return rows [text key of the measure, before, after]; correlations of the lips with the speaker's. */
export function correlationRows({ before, after }) {
  return MEASURES.map((name) => [`measure.${name}`, correlationText(before[name]), correlationText(after[name])]);
}

function correlationText(correlation) {
  return typeof correlation === "number" ? correlation.toFixed(2) : "–";
}

/** Return the key of the text that summarizes the result. */
export function verdict({ before, after }) {
  const gain = mean(after) - mean(before);
  if (mean(after) < MIN_CORRELATION || gain < -MIN_GAIN) return "resultWorse";
  return gain > MIN_GAIN ? "resultBetter" : "resultSame";
}

function mean(correlations) {
  const values = MEASURES.map((name) => correlations[name]).filter((value) => value !== null);
  return values.reduce((sum, value) => sum + value, 0) / values.length;
}
