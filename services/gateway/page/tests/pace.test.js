import assert from "node:assert/strict";
import test from "node:test";
import { Pace } from "../pace.js";

const TICK_MS = 1000 / 60;

/** Draw on a display's ticks what takes fullMs with all pixels, and leastMs more; return the pictures a second. */
function draw(pace, { fullMs, leastMs = 0, fromMs = 0 }) {
  const forMs = 10000;
  let [count, freeMs] = [0, 0];
  for (let nowMs = fromMs; nowMs < fromMs + forMs; nowMs += TICK_MS) {
    if (nowMs < freeMs || !pace.isDue(nowMs)) continue;
    freeMs = nowMs + leastMs + fullMs * pace.ratio ** 2;
    pace.drew(nowMs, freeMs);
    count++;
  }
  return (1000 * count) / forMs;
}

test("a card that is fast enough draws every tick, with all pixels", () => {
  const pace = new Pace(2, 2, false);
  assert.ok(draw(pace, { fullMs: 3 }) > 59);
  assert.equal(pace.ratio, 2);
});

test("a slow processor draws coarser until it holds 20 pictures a second", () => {
  const pace = new Pace(0.5, 1, true);
  draw(pace, { fullMs: 100, leastMs: 12 });
  assert.ok(draw(pace, { fullMs: 100, leastMs: 12, fromMs: 10000 }) > 19.5);
  assert.ok(pace.ratio < 0.5 && pace.ratio > 0.3, `${pace.ratio}`);
});

test("and finer again when it has the time", () => {
  const pace = new Pace(0.5, 1, true);
  draw(pace, { fullMs: 300 });
  draw(pace, { fullMs: 12, fromMs: 10000 });
  assert.equal(pace.ratio, 1);
});

test("a processor rests as long as it drew, and less where it would not hold 20 a second", () => {
  const pace = new Pace(0.35, 1, true);
  for (const [tookMs, restMs] of [[10, 10], [24, 24], [35, 15], [100, 10]]) {
    pace.drew(1000, 1000 + tookMs);
    const dueMs = 1000 + tookMs + restMs;
    assert.ok(!pace.isDue(dueMs - 10), `${tookMs} ms`);
    assert.ok(pace.isDue(dueMs), `${tookMs} ms`);
  }
});

test("a picture is seen, in the middle, half as long after its tick as the one before was seen", () => {
  const pace = new Pace(2, 2, false);
  for (let nowMs = 0; nowMs < 5000; nowMs += 40) pace.saw(nowMs, nowMs + 30);
  assert.ok(Math.abs(pace.untilSeenMs - 50) < 0.1, `${pace.untilSeenMs}`);
  pace.saw(5000, 5400);
  assert.ok(Math.abs(pace.untilSeenMs - 50) < 0.1, "a page that was busy once is no slow one");
  pace.saw(5500, 60000);
  assert.ok(Math.abs(pace.untilSeenMs - 50) < 0.1, "nor is one that was hidden");
});

test("one picture that took long changes nothing", () => {
  const pace = new Pace(0.5, 1, true);
  draw(pace, { fullMs: 80 });
  pace.drew(20000, 20060);
  assert.equal(pace.ratio, 0.5);
});
