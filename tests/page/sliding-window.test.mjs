import assert from "node:assert/strict";
import test from "node:test";
import { SlidingWindow } from "../../services/gateway/page/sliding-window.js";

test("an empty window has no percentile", () => {
  assert.equal(new SlidingWindow(100).percentile(0.5), null);
  assert.equal(new SlidingWindow(100).maxSince(0), Infinity);
});

test("old values are dropped", () => {
  const recent = new SlidingWindow(100);
  [9, 1, 5].forEach((value, index) => recent.add(50 * index, value));
  assert.deepEqual([recent.min, recent.percentile(0.5), recent.maxSince(0)], [1, 5, 5]);
  recent.add(130, 2);
  assert.equal(recent.percentile(1), 5, "9 is too old");
  recent.dropOld(1000);
  assert.equal(recent.count, 0);
});
