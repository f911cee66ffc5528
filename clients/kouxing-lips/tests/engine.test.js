import assert from "node:assert/strict";
import test from "node:test";
import { LipEngine } from "../engine/engine.js";

for (const [options, message] of [
  [{ sampleRateHz: 4000 }, "the sample rate 4000 Hz is out of range; use 8000 to 192000 Hz"],
  [{ shapes: ["arkit52"] }, "unknown shapes arkit52; use arkit, oculus, vrm"],
  [{ shapes: "oculus" }, 'shapes must be an array of names, such as ["arkit"]'],
  [{ expressiveness: 3 }, "expressiveness is 3; it must be a number from 0.5 to 2"],
  [{ delayMs: -1 }, "delayMs is -1; it must be a number from 0 to 300"],
  [
    { sampleRate: 48000 },
    "unknown option sampleRate; use sampleRateHz, shapes, expressiveness, feeling, delayMs, phones, models",
  ],
]) {
  test(`rejects ${JSON.stringify(options)}`, () => assert.rejects(LipEngine.load({ phones: false, ...options }), { message }));
}

for (const sample of [NaN, Infinity, 1000]) {
  test(`rejects the sample ${sample}`, async () => {
    const engine = await LipEngine.load({ phones: false });
    const message = `a sample is ${sample}; samples must be in [-1, 1]; divide integers by 32768`;
    assert.throws(() => engine.push(new Float32Array(320).fill(sample)), { message });
  });
}

for (const [strengths, holdS, message] of [
  [{ joy: NaN }, 3, "expression joy is NaN; it must be a number from 0 to 1"],
  [{ joy: undefined }, 3, "expression joy is undefined; it must be a number from 0 to 1"],
  [{ joy: 5 }, 3, "expression joy is 5; it must be a number from 0 to 1"],
  [{ joy: "0.5" }, 3, "expression joy is 0.5; it must be a number from 0 to 1"],
  [{ joy: 0.5 }, NaN, "holdS is NaN; it must be a number from 0 to 3600"],
]) {
  test(`rejects the expression ${JSON.stringify(strengths)} for ${holdS} s`, async () => {
    const engine = await LipEngine.load({ phones: false });
    assert.throws(() => engine.express(strengths, holdS), { message });
  });
}

test("finish() ends the audio", async () => {
  const engine = await LipEngine.load({ phones: false });
  engine.finish();
  const message = "finish() has ended the audio; load another engine";
  assert.throws(() => engine.push(new Float32Array(320)), { message });
  assert.throws(() => engine.finish(), { message });
});

test("rejects a path of the models that is not a URL", () =>
  assert.rejects(LipEngine.load({ models: "/models" }), { message: /^models is \/models\/, which is not a URL; in Node, use pathToFileURL/ }));

test("reports missing models", async () => {
  const message = /^cannot load file:.* or create the file with: kouxing export web$/;
  await assert.rejects(LipEngine.load({ models: new URL("none/", import.meta.url) }), { message });
});
