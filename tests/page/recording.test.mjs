// The time of a recording that <kouxing-face> plays.

import assert from "node:assert/strict";
import test from "node:test";
import { recordingClock } from "../../clients/javascript/recording.js";

test("the time of a recording follows its audio, and continues after the audio has ended", () => {
  let ms = 1000;
  const audio = { currentTime: 0, ended: false };
  const [heard, silent] = [audio, null].map((source) => recordingClock(source, () => ms));
  ms += 700; // the audio starts later than the clock
  assert.deepEqual([heard(), silent()], [0, 0.7]);
  audio.currentTime = 6.2;
  assert.equal(heard(), 6.2);
  audio.ended = true;
  ms += 250;
  assert.equal(heard(), 6.45);
});
