import assert from "node:assert/strict";
import { test } from "node:test";
import { mouthLight } from "../../services/gateway/page/mouth-light.js";

// The same values as in tests/unit/test_mouth_pictures.py.
for (const [upper, lower, pushed, light] of [
  [0, 0, 0, 0.08],
  [0, -120, 0, 0.5698],
  [-20, -120, 260, 0.4065],
  [-280, -600, 70, 0.9242],
]) {
  test(`lips at ${upper} and ${lower}, pushed ${pushed}`, () => {
    const faps = new Float32Array(68);
    [faps[3], faps[4], faps[15], faps[16]] = [upper, lower, pushed, pushed];
    assert.ok(Math.abs(mouthLight(faps) - light) < 1e-4);
  });
}
