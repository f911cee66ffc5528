// Reads the .csv and .jsonl files of `kouxing listen -o` and `kouxing render`, with FAPs or shapes,
// and takes (.csv) of the Live Link Face app. Frames of a take without a face, with a count of 0, are left out.
// Tables of spreadsheet programs may be in UTF-16, and have semicolons or tabs with decimal commas.
// The values of these tables are numbers, times and names, so no CSV package is needed. Quotes are removed.

const RATE_HZ = 16000;
// A time code counts frames, but the file does not name their rate. It is the lowest of these above
// all counts, or the app's default if the take does not cross a full second.
const TIME_CODE_RATES_HZ = [24, 25, 30, 48, 50, 60, 100, 120];
const DAY_S = 86400;
const MAX_WEIGHT = 10; // limit for the weight of a shape; percentages are larger

/**
 * Read a recording.
 *
 * @param {string | ArrayBuffer | Uint8Array} content of the file
 * @returns { names: of the shapes, or null for the 68 FAPs, frames: [[media time, Float32Array]] }
 * @throws {Error} if the table has no times or no frames, a value is not a number, or a time is earlier than the previous one
 */
export function readRecording(content) {
  const text = typeof content === "string" ? content.replace(/^\uFEFF/, "") : decodeText(new Uint8Array(content));
  const lines = text.split(/\r\n|\r|\n/).filter((line) => /[^ ,;\t]/.test(line) && !line.startsWith("sep=")); // "sep=" is from Excel
  if (lines.length === 0) throw new Error("the recording is empty; record it again");
  const recording = lines[0].startsWith("{") ? readJsonLines(lines) : readCsv(lines.map(removeQuotes));
  if (recording.frames.length === 0) throw new Error("the recording has no frames with a face; record it again");
  const wrong = recording.frames.findIndex(
    ([time, values]) => !Number.isFinite(time) || !values.every(Number.isFinite),
  );
  if (wrong >= 0) throw new Error(`frame ${wrong + 1} of the recording: a value is missing or not a number`);
  const early = recording.frames.findIndex(([time], number, frames) => time < frames[number - 1]?.[0]);
  if (early >= 0) throw new Error(`frame ${early + 1} of the recording: its time is earlier than the previous frame's; sort the frames by time`);
  if (recording.names !== null && recording.frames.some(([, values]) => values.some((value) => Math.abs(value) > MAX_WEIGHT))) {
    throw new Error("values of shapes must be from 0 to 1; divide percentages by 100");
  }
  return recording;
}

function decodeText(bytes) {
  const encodings = { 0xfffe: "utf-16le", 0xfeff: "utf-16be" }; // by byte order mark
  return new TextDecoder(encodings[(bytes[0] << 8) | bytes[1]]).decode(bytes);
}

/**
 * Return a function that returns the time to show, seconds.
 *
 * A recording may be longer than its audio, because the face returns to rest. After the audio, time continues.
 * Without audio, or if the first frame is not within the audio, the first frame is shown at once.
 *
 * @param audio HTMLAudioElement that plays the sound; null for silence
 * @param firstS time of the first frame, seconds
 * @param nowMs function that returns the page's time, ms
 */
export function recordingClock(audio, firstS, nowMs = () => performance.now()) {
  let startMs = nowMs(); // of the silent part
  const startS = firstS >= 0 && firstS < audio?.duration ? 0 : firstS;
  return () => {
    if (audio && !audio.ended) startMs = nowMs();
    return startS + (audio?.currentTime ?? 0) + (nowMs() - startMs) / 1000;
  };
}

function readJsonLines(lines) {
  let [set, names] = ["", null];
  const frames = lines.map((line, number) => {
    try {
      const object = JSON.parse(line);
      if (number === 0) {
        set = Object.keys(object).find((key) => !["time_s", "sequence"].includes(key));
        names = Array.isArray(object[set]) ? null : Object.keys(object[set]);
      }
      const values = names === null ? object[set] : names.map((name) => object[set][name]);
      return [object.time_s * RATE_HZ, Float32Array.from(values, (value) => value ?? NaN)];
    } catch {
      throw new Error(`line ${number + 1} of the recording is not a frame with time_s and the values of a face; record it again`);
    }
  });
  return { names, frames };
}

/** Return a line without quotes. A comma between quotes is a decimal comma. */
function removeQuotes(line) {
  return line.replaceAll(/"([^"]*)"/g, (_, cell) => cell.replaceAll(",", "."));
}

/** Return the cells of each line, separated by commas, semicolons or tabs. */
function splitCells(lines) {
  const count = (separator) => lines[0].split(separator).length;
  const delimiter = [",", ";", "\t"].reduce((most, separator) => (count(separator) > count(most) ? separator : most));
  return lines.map((line) => (delimiter === "," ? line : line.replaceAll(",", ".")).split(delimiter));
}

function readCsv(lines) {
  const [header, ...cells] = splitCells(lines);
  const titles = header.map((title) => title.trim());
  const timeColumn = titles.findIndex((title) => /^(time_s|timecode)$/i.test(title));
  if (timeColumn < 0) throw new Error("the recording has no times; add a column time_s or Timecode");
  const isTake = titles[timeColumn].toLowerCase() === "timecode";
  const isText = (column) => cells.every((row) => row[column]?.trim() && Number.isNaN(readNumber(row[column])));
  const values = titles.flatMap((title, column) =>
    column === timeColumn || /^(|sequence|phone|blendshapecount)$/i.test(title) ? [] : [column],
  );
  const columns = values.every(isText) ? values : values.filter((column) => !isText(column)); // without comments
  const names = columns.map((column) =>
    isTake ? titles[column][0].toLowerCase() + titles[column].slice(1) : titles[column],
  );
  const countColumn = titles.findIndex((title) => /^blendshapecount$/i.test(title));
  const rows = cells.filter((row) => row[countColumn]?.trim() !== "0");
  const times = rows.map((row) => row[timeColumn]);
  const timesS = isTake ? readTimeCodes(times) : times.map(readNumber);
  return {
    names: names[0] === "viseme" ? null : names,
    frames: rows.map((row, number) => [
      timesS[number] * RATE_HZ,
      Float32Array.from(columns, (column) => readNumber(row[column])),
    ]),
  };
}

/** Return the number in a cell; NaN for an empty or missing cell. */
function readNumber(cell) {
  return cell?.trim() ? Number(cell) : NaN;
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
