import assert from "node:assert/strict";
import test from "node:test";
import { FrameTrack } from "../frame-track.js";

const frame = (timeS, jaw) => ({ timeS, faps: Float32Array.of(jaw), isSpeaking: jaw > 0 });

test("a face between two frames is mixed from both", () => {
  const track = new FrameTrack(60);
  assert.equal(track.at(0), null);
  track.push([frame(1, 0), frame(1.02, 8)]);
  assert.deepEqual(track.at(1.015), { timeS: 1.015, faps: Float32Array.of(6), isSpeaking: false });
});

test("before the first and after the last frame, the nearest one is shown", () => {
  const track = new FrameTrack(60);
  track.push([frame(1, 2), frame(1.02, 8)]);
  assert.equal(track.at(0).faps[0], 2);
  assert.equal(track.at(9).faps[0], 8);
});

test("older frames are dropped", () => {
  const track = new FrameTrack(60);
  track.push([frame(0, 1), frame(30, 2)]);
  track.push([frame(70, 3)]);
  assert.equal(track.at(0).faps[0], 2);
});

test("the face at every time of a long track is known", () => {
  const track = new FrameTrack(3600);
  for (let number = 0; number < 6000; number++) track.push([frame(number / 50, number)]);
  for (const number of [0, 1, 50, 2999, 5998]) {
    assert.equal(track.at(number / 50).faps[0], number);
    assert.ok(Math.abs(track.at((number + 0.5) / 50).faps[0] - number - 0.5) < 1e-3);
  }
});

test("an hour of frames can arrive at once", () => {
  const track = new FrameTrack(60);
  track.push(Array.from({ length: 180000 }, (_, number) => frame(number / 50, number)));
  assert.equal(track.endS, 179999 / 50);
  assert.equal(track.at(0).timeS, 179999 / 50 - 60);
});
