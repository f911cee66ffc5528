import assert from "node:assert/strict";
import test from "node:test";
import { ProductMemory } from "../engine/products.js";
import { Resampler } from "../engine/resampler.js";

const MODEL = { constants: { resample: { SAMPLE_RATE_HZ: 16_000, HALF_WIDTH: 32, CUTOFF: 15 / 16, KAISER_BETA: 8, MAX_PHASES: 640 } } };

for (const [rateHz, numTaps] of [
  [8_001, 64],
  [47_999, 192],
  [191_999, 768],
]) {
  test(`the filter of ${rateHz} Hz is small`, (context) => {
    const arrays = context.mock.method(ProductMemory.prototype, "array");
    new Resampler(rateHz, MODEL);
    const [[, tableSize]] = arrays.mock.calls.map((call) => call.arguments);
    assert.equal(tableSize, 641 * numTaps); // a row for each of 16,000 phases would take seconds
  });
}
