// The block network's input, with a fake network of one state.

import assert from "node:assert/strict";
import test from "node:test";
import { BlockScorer } from "../engine/block-scorer.js";

const FLOOR_BANDS = 2;
const PADDING = 2;
const SHAPES = {
  frames: [1, 11, 1],
  positions: [1, 4, 4], // four encoder frames
  new: [1, 2, 1, 2, 1], // keys and values of one layer, in blocks of two encoder frames
  keys_0: [1, 1, 4, 1],
  values_0: [1, 1, 4, 1],
};

/** A network whose score of a feature frame is the first band of the next feature frame. */
class FakeNetwork {
  #arrays = {};
  shape(name) {
    return SHAPES[name];
  }
  values(name) {
    return (this.#arrays[name] ??= new Float32Array(16));
  }
  run() {
    this.values("log_posteriors").set(this.values("frames").subarray(PADDING + 1, PADDING + 1 + 2 * this.values("num_positions")[0]));
  }
}

/** Return the scores of speech with one band, in encoder frames that arrive one by one. */
function score(bands) {
  const scorer = new BlockScorer({
    blocks: new FakeNetwork(),
    phoneArrays: { block_log_prior: { values: Float32Array.of(0) } },
    phones: { acousticScale: 1 },
    constants: {
      blocks: { PADDING, RIGHT_CONTEXT_FRAMES: 2 },
      network: { FRAMES_PER_ENCODER_FRAME: 2, MAX_POSITIONS: 100, LONGEST_WAVE: 10000 },
      mel: { FLOOR_BANDS },
    },
  });
  const settled = [];
  for (let i = 0; i < bands.length; i += 2) {
    const numFrames = Math.min(2, bands.length - i);
    // an encoder frame of which only the last feature frames belong to the speech
    const features = Float32Array.of(...Array(2 - numFrames).fill(-9), ...bands.slice(i, i + numFrames));
    settled.push(...scorer.accept([{ features }], numFrames).settled);
  }
  return [...settled, ...scorer.finish()].map(([value]) => value);
}

for (const numFrames of [1, 2, 7, 20, 21]) {
  test(`the last of ${numFrames} frames is repeated until all are scored`, () => {
    const bands = Array.from({ length: numFrames }, (_, i) => (i % 3) / 2);
    assert.deepEqual(score(bands), [...bands.slice(1), bands.at(-1)]);
  });
}

test("bands far below the highest band so far are raised to a floor", () => {
  assert.deepEqual(score([-1, -9, 3, 0.5, 5, 4, 0, 6, -9]), [-3, 3, 1, 5, 4, 3, 6, 4, 4]);
});
