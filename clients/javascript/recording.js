// Reads the .csv and .jsonl files of `kouxing listen -o` and `kouxing render`, with FAPs or shapes,
// and takes (.csv) of the app Live Link Face. Frames of a take without a face, with a count of 0, are left out.
// The values of these tables are numbers, times and names without commas or quotes, so no CSV package is needed.

const RATE_HZ = 16000;
// A time code counts frames, but the file does not name their rate. It is the lowest of these above
// all counts, or the app's default if the take does not cross a full second.
const TIME_CODE_RATES_HZ = [24, 25, 30, 48, 50, 60, 100, 120];
const DAY_S = 86400;

/**
 * Read a recording.
 *
 * @param {string} text content of the file
 * @returns { names: of the shapes, or null for the 68 FAPs, frames: [[media time, Float32Array]] }
 * @throws {Error} if the table has no times or no frames, or a value is not a number
 */
export function readRecording(text) {
  const lines = text.replace(/^\uFEFF/, "").trim().split(/\r?\n/);
  const recording = lines[0].startsWith("{") ? readJsonLines(lines) : readCsv(lines);
  if (recording.frames.length === 0) throw new Error("the recording has no frames with a face; record it again");
  const wrong = recording.frames.findIndex(
    ([time, values]) => !Number.isFinite(time) || !values.every(Number.isFinite),
  );
  if (wrong >= 0) throw new Error(`frame ${wrong + 1} of the recording: a value is missing or not a number`);
  return recording;
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

function readCsv([header, ...lines]) {
  const titles = header.split(",").map((title) => title.trim());
  const timeColumn = titles.findIndex((title) => /^(time_s|timecode)$/i.test(title));
  if (timeColumn < 0) throw new Error("the recording has no times; add a column time_s or Timecode");
  const isTake = titles[timeColumn] !== "time_s";
  const columns = titles.flatMap((title, column) =>
    column === timeColumn || /^(phone|blendshapecount)$/i.test(title) ? [] : [column],
  );
  const names = columns.map((column) =>
    isTake ? titles[column][0].toLowerCase() + titles[column].slice(1) : titles[column],
  );
  const countColumn = titles.findIndex((title) => /^blendshapecount$/i.test(title));
  const rows = lines.map((line) => line.split(",")).filter((row) => row[countColumn]?.trim() !== "0");
  const times = rows.map((row) => row[timeColumn]);
  const timesS = isTake ? readTimeCodes(times) : times.map(Number);
  return {
    names: names[0] === "viseme" ? null : names,
    frames: rows.map((row, number) => [
      timesS[number] * RATE_HZ,
      Float32Array.from(columns, (column) => (row[column] ? Number(row[column]) : NaN)),
    ]),
  };
}

/** Return the seconds since the first of the time codes HH:MM:SS:FF.fff, or HH:MM:SS;FF.fff if frames are dropped. */
function readTimeCodes(codes) {
  const fields = codes.map((code) => code.split(/[:;]/).map(Number));
  const crossesSecond = fields.some(([, , second]) => second !== fields[0][2]);
  const lastFrame = fields.reduce((last, [, , , frame]) => Math.max(last, frame), 0);
  const lowestHz = crossesSecond ? lastFrame : Math.max(59, lastFrame);
  const rate = TIME_CODE_RATES_HZ.find((rateHz) => lowestHz < rateHz) ?? 60;
  const timesS = fields.map(([hours, minutes, seconds, frame]) => 3600 * hours + 60 * minutes + seconds + frame / rate);
  return timesS.map((timeS) => timeS - timesS[0] + (timeS < timesS[0] ? DAY_S : 0));
}
