import assert from "node:assert/strict";
import test from "node:test";
import { Lateness } from "../../services/gateway/page/lateness.js";
import { SAMPLES_PER_MS } from "../../services/gateway/page/playout.js";

const [FRAME_MS, UPDATE_MS] = [20, 100];

/** Frames arrive in real time; `update` is called as the page does. */
class Stream {
  lateness = new Lateness();
  nowMs = 5000;
  #mediaMs = 0;
  #sentMs = 0;

  /** Run for a time; return isBehind at each update. The frames that are due arrive in order. */
  run(forMs, lateMs = 0, { isLive = true, isPaused = false, imageMs = null } = {}) {
    const states = [];
    for (const endMs = this.nowMs + forMs; this.nowMs < endMs; ) {
      this.nowMs += FRAME_MS;
      if (isPaused) this.#send();
      else this.#mediaMs += FRAME_MS;
      for (; this.#sentMs < this.#mediaMs - lateMs; this.#send()) this.#sentMs += FRAME_MS;
      if (this.nowMs % UPDATE_MS > 0) continue;
      if (imageMs !== null) this.lateness.imageVisible(this.nowMs - imageMs, this.nowMs);
      this.lateness.update(this.nowMs, isLive);
      states.push(this.lateness.isBehind);
    }
    return states;
  }

  /** Skip the frames that are late. */
  skip() {
    this.#sentMs = this.#mediaMs;
  }

  #send() {
    this.lateness.frameArrived(this.nowMs, this.#sentMs * SAMPLES_PER_MS);
  }
}

test("the page is behind after a second of late frames, and in time after two seconds", () => {
  const stream = new Stream();
  assert.deepEqual(new Set(stream.run(5000, 0)), new Set([false]));
  assert.deepEqual(new Set(stream.run(1000, 500)), new Set([false]));
  assert.equal(stream.run(1000, 500).at(-1), true);
  assert.ok(Math.abs(stream.lateness.recentMs - 500) < 60, `${stream.lateness.recentMs}`);
  assert.deepEqual(new Set(stream.run(1800, 0)), new Set([true]));
  assert.equal(stream.run(500, 0).at(-1), false);
});

test("frames that are a little late, or late for a moment, change nothing", () => {
  const stream = new Stream();
  stream.run(1000);
  assert.deepEqual(new Set(stream.run(5000, 200)), new Set([false]));
  for (let i = 0; i < 5; i++) {
    assert.deepEqual(new Set([...stream.run(800, 500), ...stream.run(300)]), new Set([false]));
  }
  stream.run(2000, 500);
  for (let i = 0; i < 5; i++) {
    assert.deepEqual(new Set([...stream.run(1300), ...stream.run(600, 500)]), new Set([true]));
  }
});

test("the page is behind while frames are skipped", () => {
  const stream = new Stream();
  stream.run(1000);
  assert.equal(stream.run(200, 200).at(-1), false);
  stream.skip();
  assert.deepEqual(new Set(stream.run(1800)), new Set([true]));
  assert.equal(stream.run(500).at(-1), false);
});

test("frames that do not arrive are late", () => {
  const stream = new Stream();
  stream.run(1000);
  for (const afterMs of [500, 1000, 1500]) stream.lateness.update(stream.nowMs + afterMs, true);
  assert.equal(stream.lateness.isBehind, true);
});

test("the page is behind while images are visible late, although frames arrive in time", () => {
  const stream = new Stream();
  assert.equal(stream.run(3000, 0, { imageMs: 150 }).at(-1), false);
  assert.equal(stream.run(3000, 0, { imageMs: 1900 }).at(-1), true);
  assert.ok(stream.lateness.recentMs >= 1900, `${stream.lateness.recentMs}`);
  assert.equal(stream.run(6000).at(-1), false, "a face that does not move");
});

test("a pause of the audio and a session that has ended are not behind", () => {
  const stream = new Stream();
  stream.run(1000);
  assert.deepEqual(new Set(stream.run(5000, 0, { isPaused: true })), new Set([false]));
  assert.deepEqual(new Set(stream.run(3000)), new Set([false]), "media time resumes");
  stream.run(3000, 500);
  assert.equal(stream.run(2500, 500, { isLive: false }).at(-1), false);
});
