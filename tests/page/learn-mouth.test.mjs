import assert from "node:assert/strict";
import test from "node:test";
import { curvePath, extent, correlationRows, verdict } from "../../services/gateway/page/lip-curves.js";
import { FaceRecording } from "../../services/gateway/page/face-recording.js";

const RATE_HZ = 48000;
const CHUNK = Int16Array.from({ length: 960 }, (_, i) => i);
const LOUD = 0.1;

/** Return the landmarks of a face; landmark i is at (i, i + 0.25, -i). */
function face() {
  return Float32Array.from({ length: 478 * 3 }, (_, k) => {
    const index = Math.floor(k / 3);
    return [index, index + 0.25, -index][k % 3];
  });
}

/** Record sound and images from 1000 ms on. */
function record({ seconds, rms = LOUD, hasFace = () => true, everyMs = 40 }) {
  const recording = new FaceRecording(RATE_HZ);
  for (let ms = 0; ms < 1000 * seconds; ms += 20) {
    recording.addSound(1020 + ms, CHUNK, rms);
    if (ms % everyMs === 0) recording.addFace(1010 + ms, hasFace(ms) ? face() : null);
  }
  return recording;
}

async function parse(recording) {
  const bytes = await recording.encode().arrayBuffer();
  const view = new DataView(bytes);
  const numHeader = view.getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(bytes.slice(4, 4 + numHeader)));
  let at = 4 + numHeader;
  const times = Array.from({ length: header.times }, (_, i) => view.getFloat64(at + 8 * i, true));
  at += 8 * header.times;
  const frame = Array.from({ length: 3 * header.points }, (_, i) => view.getFloat32(at + 4 * i, true));
  at += 12 * header.points * header.times;
  return { header, times, frame, sound: new Int16Array(bytes.slice(at)) };
}

test("a recording is encoded as a landmark file", async () => {
  const { header, times, frame, sound } = await parse(record({ seconds: 1 }));
  assert.deepEqual(header, { times: 25, points: 43, sample_rate_hz: RATE_HZ });
  times.forEach((time, i) => assert.ok(Math.abs(time - 0.01 - 0.04 * i) < 1e-9, `${time}`));
  assert.deepEqual(frame.slice(0, 6), [0, 0.25, -0, 2, 2.25, -2]);
  assert.deepEqual(frame.slice(-3), [420, 420.25, -420]);
  assert.equal(sound.length, RATE_HZ);
  assert.deepEqual(sound.subarray(960, 1920), CHUNK);
});

test("times increase from the first sample on, even if clocks disagree", async () => {
  const recording = new FaceRecording(RATE_HZ);
  recording.addFace(900, face()); // before the sound begins
  recording.addSound(1050, CHUNK, LOUD); // delivered 30 ms late
  recording.addSound(1040, CHUNK, LOUD);
  for (const ms of [1010, 1010, 1005, 1030]) recording.addFace(ms, face());
  assert.deepEqual((await parse(recording)).times, [0.01, 0.03]);
});

test("a recording without a face or a voice has a problem", () => {
  assert.equal(record({ seconds: 6 }).problem(), null);
  assert.equal(record({ seconds: 6, hasFace: (ms) => ms < 3000 }).problem(), "noFace");
  assert.equal(record({ seconds: 6, rms: 0.001 }).problem(), "tooQuiet");
  assert.equal(new FaceRecording(RATE_HZ).problem(), "noFace");
  const good = record({ seconds: 6 });
  assert.deepEqual(good.advice(8100), null, "no image is newer than the last face");
  good.addFace(8000, null);
  assert.deepEqual(good.advice(8000), "noFace");
  assert.equal(record({ seconds: 6, rms: 0 }).advice(7000), "tooQuiet");
  assert.equal(record({ seconds: 3, rms: 0 }).advice(4000), null, "a pause is allowed");
  assert.equal(record({ seconds: 6, everyMs: 200 }).problem(), null);
  const begun = new FaceRecording(RATE_HZ);
  assert.equal(begun.problem(), "noFace");
  begun.addFace(5000, face());
  assert.equal(begun.advice(9000), null, "the sound begins later, and a slow tracker answers late");
  assert.equal(begun.problem(), "tooQuiet");
  assert.equal(record({ seconds: 6, everyMs: 240 }).problem(), "tooSlow");
});

test("a curve is scaled to its box and has gaps at missing values", () => {
  const box = { width: 100, height: 10, low: 0, high: 20 };
  const times = [5, 5.02, 5.04, 5.06, 5.08, 5.5, 6];
  const path = curvePath(times, [0, 20, null, 10, 10, 10, 0], box);
  assert.equal(path, "M0.0 10.0L2.0 0.0M6.0 5.0L8.0 5.0M50.0 5.0M100.0 10.0");
  assert.deepEqual(extent([3, null], [null, -1, 2]), { low: -1, high: 3 });
});

test("a verdict summarizes the correlations", () => {
  const before = { opening: 0.5, width: 0.412, jaw: null };
  const withOpening = (opening) => ({ before, after: { ...before, opening } });
  assert.deepEqual(correlationRows(withOpening(0.6)), [
    ["measure.opening", "0.50", "0.60"],
    ["measure.width", "0.41", "0.41"],
    ["measure.jaw", "–", "–"],
  ]);
  assert.equal(verdict(withOpening(0.6)), "resultBetter");
  assert.equal(verdict(withOpening(0.51)), "resultSame");
  assert.equal(verdict(withOpening(0.4)), "resultWorse");
  const poor = { opening: 0.1, width: 0.1, jaw: 0 };
  assert.equal(verdict({ before: poor, after: { ...poor, opening: 0.3 } }), "resultWorse");
});
