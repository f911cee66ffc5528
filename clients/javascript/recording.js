// Reads the .csv and .jsonl files of `kouxing listen -o` and `kouxing render -o`: FAPs or shapes.

const RATE_HZ = 16000;

/**
 * Read a recording.
 *
 * @param {string} text content of the file
 * @returns { names: of the shapes, or null for the 68 FAPs, frames: [[media time, Float32Array]] }
 */
export function readRecording(text) {
  const lines = text.trim().split(/\r?\n/);
  return lines[0].startsWith("{") ? readJsonLines(lines) : readCsv(lines);
}

function readJsonLines(lines) {
  const objects = lines.map((line) => JSON.parse(line));
  const set = Object.keys(objects[0]).find((key) => !["time_s", "sequence"].includes(key));
  const names = Array.isArray(objects[0][set]) ? null : Object.keys(objects[0][set]);
  return {
    names,
    frames: objects.map((object) => {
      const values = names === null ? object[set] : names.map((name) => object[set][name]);
      return [object.time_s * RATE_HZ, Float32Array.from(values)];
    }),
  };
}

function readCsv([header, ...rows]) {
  const names = header.split(",").slice(1);
  return {
    names: names[0] === "viseme" ? null : names,
    frames: rows.map((row) => {
      const [timeS, ...values] = row.split(",").map(Number);
      return [timeS * RATE_HZ, Float32Array.from(values)];
    }),
  };
}
