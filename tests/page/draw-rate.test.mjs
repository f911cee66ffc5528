import assert from "node:assert/strict";
import test from "node:test";
import { DrawRate, ImageQueue } from "../../services/gateway/page/draw-rate.js";

const TICK_MS = 1000 / 60;

/** Draw images that take minMs + fullMs * ratio ** 2; return their number per second. */
function draw(drawRate, { fullMs, minMs = 0, fromMs = 0 }) {
  const forMs = 10000;
  let [count, freeMs] = [0, 0];
  for (let nowMs = fromMs; nowMs < fromMs + forMs; nowMs += TICK_MS) {
    if (nowMs < freeMs || !drawRate.isDue(nowMs)) continue;
    freeMs = nowMs + minMs + fullMs * drawRate.ratio ** 2;
    drawRate.recordDrawn(nowMs, freeMs);
    count++;
  }
  return (1000 * count) / forMs;
}

test("a slow processor draws fewer pixels until it draws 20 images a second", () => {
  const drawRate = new DrawRate({ ratio: 0.5, maxRatio: 1, pauses: true });
  draw(drawRate, { fullMs: 100, minMs: 12 });
  assert.ok(draw(drawRate, { fullMs: 100, minMs: 12, fromMs: 10000 }) > 19.5);
  assert.ok(drawRate.ratio < 0.5 && drawRate.ratio > 0.3, `${drawRate.ratio}`);
  draw(drawRate, { fullMs: 12, fromMs: 20000 });
  assert.equal(drawRate.ratio, 1, "it has the time again");
});

test("very slow images get far fewer pixels at once, but not because of one stall", () => {
  const drawRate = new DrawRate({ ratio: 1, pauses: true });
  const record = (tookMs) => drawRate.recordDrawn(0, tookMs);
  for (const tookMs of [900, 20, 900]) record(tookMs); // such as the first image of a page
  assert.equal(drawRate.ratio, 1);
  for (let number = 0; number < 7; number++) record(20);
  assert.ok(drawRate.ratio >= 0.85, `${drawRate.ratio}`);
  const verySlow = new DrawRate({ ratio: 1, pauses: true });
  for (let number = 0; number < 3; number++) verySlow.recordDrawn(0, 400);
  assert.equal(verySlow.ratio, 0.35);
});

test("a processor pauses as long as it drew, or less to draw 20 images a second", () => {
  const drawRate = new DrawRate({ ratio: 0.35, maxRatio: 1, pauses: true });
  for (const [tookMs, restMs] of [[10, 10], [24, 24], [35, 15], [100, 10]]) {
    drawRate.recordDrawn(1000, 1000 + tookMs);
    const dueMs = 1000 + tookMs + restMs;
    assert.ok(!drawRate.isDue(dueMs - 10), `${tookMs} ms`);
    assert.ok(drawRate.isDue(dueMs), `${tookMs} ms`);
  }
});

test("the delay of an image includes half of the time for which it is visible", () => {
  const drawRate = new DrawRate({ ratio: 2, pauses: false });
  for (let nowMs = 0; nowMs < 5000; nowMs += 40) drawRate.recordVisible(nowMs, nowMs + 30);
  assert.ok(Math.abs(drawRate.visibleDelayMs - 50) < 0.1, `${drawRate.visibleDelayMs}`);
  drawRate.recordVisible(5000, 5400); // a slow image
  assert.ok(Math.abs(drawRate.visibleDelayMs - 50) < 0.1, `${drawRate.visibleDelayMs}`);
  for (let nowMs = 6000; nowMs < 12000; nowMs += 1900) drawRate.recordVisible(nowMs, nowMs + 1900);
  assert.ok(drawRate.visibleDelayMs > 1900, `${drawRate.visibleDelayMs}`);
});

test("images of a page that was hidden in the meantime do not count", (t) => {
  const page = new EventTarget();
  const ticks = [];
  let nowMs = 0;
  const doubles = {
    document: page,
    performance: { now: () => nowMs },
    setTimeout: (callback) => callback(),
    requestAnimationFrame: (callback) => ticks.push(callback),
  };
  const before = Object.fromEntries(Object.keys(doubles).map((name) => [name, globalThis[name]]));
  Object.assign(globalThis, doubles);
  t.after(() => Object.assign(globalThis, before));
  const gl = { fenceSync: () => ({}), flush() {}, clientWaitSync: () => 0, deleteSync() {} };
  const drawRate = new DrawRate({ ratio: 1, pauses: false });
  const queue = new ImageQueue({ ...gl, TIMEOUT_EXPIRED: 1 }, drawRate);
  let numVisible = 0;
  const show = (seenAfterMs, isHidden) => {
    queue.draw(nowMs, () => {}, () => numVisible++);
    if (isHidden) page.dispatchEvent(new Event("visibilitychange"));
    nowMs += seenAfterMs;
    ticks.pop()(nowMs);
  };
  for (let i = 0; i < 20; i++) show(40, false);
  show(60000, true);
  assert.ok(drawRate.visibleDelayMs < 100, `${drawRate.visibleDelayMs}`);
  assert.equal(numVisible, 20);
  show(1900, false);
  assert.ok(drawRate.visibleDelayMs >= 1900, `${drawRate.visibleDelayMs}`);
  queue.close();
  show(40, true);
  assert.equal(numVisible, 22); // it no longer follows whether the page is hidden
});

test("the user can halve the number of images, down to about 4 a second", () => {
  for (const [drawRate, rates] of [
    [new DrawRate({ ratio: 2, pauses: false }), [60, 30, 15, 7.5, 3.75]],
    [new DrawRate({ ratio: 0.35, pauses: true }), [20, 10, 5]],
  ]) {
    let fromMs = 0;
    for (const rate of rates) {
      assert.equal(drawRate.isReduced, rate < rates[0]);
      const perSecond = draw(drawRate, { fullMs: 0, minMs: rates[0] === 20 ? 26 : 5, fromMs });
      assert.ok(Math.abs(perSecond - rate) <= 0.2 * rate, `${perSecond} instead of ${rate}`);
      assert.equal(drawRate.canHalve, rate !== rates.at(-1));
      drawRate.halve();
      fromMs += 10000;
    }
    drawRate.restore();
    assert.ok(draw(drawRate, { fullMs: 0, minMs: 5, fromMs }) > 50);
  }
});
