import assert from "node:assert/strict";
import test from "node:test";
import { Recent } from "../recent.js";

test("without values there is no percentile", () => {
  assert.equal(new Recent(100).percentile(0.5), null);
  assert.equal(new Recent(100).greatestSince(0), Infinity);
});

test("values count for a while", () => {
  const recent = new Recent(100);
  [9, 1, 5].forEach((value, index) => recent.add(50 * index, value));
  assert.deepEqual([recent.least, recent.percentile(0.5), recent.greatestSince(0)], [1, 5, 5]);
  recent.add(130, 2);
  assert.equal(recent.percentile(1), 5, "the 9 is too old");
  recent.forget(1000);
  assert.equal(recent.count, 0);
});
