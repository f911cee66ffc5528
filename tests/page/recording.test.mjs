// The time of a recording that <kouxing-face> plays.

import assert from "node:assert/strict";
import test from "node:test";
import { recordingClock } from "../../clients/javascript/recording.js";

test("the time of a recording follows its audio, and continues after the audio has ended", () => {
  let ms = 1000;
  const audio = { currentTime: 0, duration: 6.2, ended: false };
  const [heard, silent] = [audio, null].map((source) => recordingClock(source, 0, () => ms));
  ms += 700; // the audio starts later than the clock
  assert.deepEqual([heard(), silent()], [0, 0.7]);
  audio.currentTime = 6.2;
  assert.equal(heard(), 6.2);
  audio.ended = true;
  ms += 250;
  assert.equal(heard(), 6.45);
});

test("a recording that was started late is in sync with its audio, or starts at once", () => {
  const audio = { currentTime: 0, duration: 130, ended: false };
  const firstTimes = [[audio, 120], [audio, 140], [audio, -1], [null, 120]].map(([source, firstS]) =>
    recordingClock(source, firstS, () => 0)(),
  );
  assert.deepEqual(firstTimes, [0, 140, -1, 120]);
});
