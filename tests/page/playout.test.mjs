import assert from "node:assert/strict";
import test from "node:test";
import { FapTrack, Playout, SAMPLES_PER_MS } from "../../services/gateway/page/playout.js";

const FRAME_MS = 20;

/** Let sound and frames arrive in real time, each frame frameMs after its sound. */
function stream(playout, { fromMs = 0, forMs, clockMs = 0, frameMs = 80 }) {
  for (let ms = fromMs; ms < fromMs + forMs; ms += FRAME_MS) {
    const nowMs = ms + FRAME_MS + clockMs;
    playout.soundArrived(nowMs, ms * SAMPLES_PER_MS, FRAME_MS * SAMPLES_PER_MS);
    const frameTimeMs = ms + FRAME_MS - frameMs;
    if (frameTimeMs >= 0) playout.frameArrived(nowMs, frameTimeMs * SAMPLES_PER_MS);
    playout.adjust(nowMs);
  }
}

test("sound waits for its image and one more FAP frame", () => {
  const playout = new Playout();
  stream(playout, { forMs: 20000, frameMs: 180 });
  assert.ok(Math.abs(playout.delayMs - 200) <= 30, `${playout.delayMs}`);
  const silent = new Playout();
  silent.isAudible = false;
  stream(silent, { forMs: 20000, frameMs: 180 });
  assert.ok(Math.abs(silent.delayMs - 180) <= 5, "without sound, the face waits only for most frames");
});

test("a face that is far behind its sound from the start is shown", () => {
  for (const frameMs of [400, 600, 2000]) {
    for (const isAudible of [true, false]) {
      const playout = new Playout();
      playout.isAudible = isAudible;
      stream(playout, { forMs: frameMs + 3000, frameMs });
      assert.ok(Math.abs(playout.frameWaitMs) <= 30, `${playout.frameWaitMs} at ${frameMs}`);
      assert.ok(Math.abs(playout.delayMs - frameMs) <= 30, `${playout.delayMs} at ${frameMs}`);
      assert.ok(playout.frames.count > 50, "it did not start again");
    }
  }
});

test("a queued stream starts with the delay of its end", () => {
  const playout = new Playout();
  for (let ms = 0; ms < 1000; ms += FRAME_MS) {
    const nowMs = 1000 + ms / 20; // the queue arrives within 50 ms
    playout.soundArrived(nowMs, ms * SAMPLES_PER_MS, FRAME_MS * SAMPLES_PER_MS);
    if (ms >= 60) playout.frameArrived(nowMs, (ms - 60) * SAMPLES_PER_MS);
  }
  stream(playout, { fromMs: 1040, forMs: 100 });
  assert.ok(Math.abs(playout.delayMs - 120) <= 20, `${playout.delayMs}`);
});

test("sound waits for a slow loudspeaker", () => {
  const playout = new Playout();
  playout.outputLatencyMs = 600;
  stream(playout, { forMs: 20000 });
  assert.ok(Math.abs(playout.delayMs - 640) <= 20, `${playout.delayMs}`);
  assert.ok(playout.frames.count > 400, "it did not start again");
});

test("a small error is corrected by gliding", () => {
  const playout = new Playout();
  stream(playout, { forMs: 10000 });
  const before = playout.offsetMs;
  stream(playout, { fromMs: 10000, forMs: 3000, frameMs: 100 });
  const glidedMs = playout.offsetMs - before;
  assert.ok(glidedMs > 9 && glidedMs <= 15, `${glidedMs}: 5 ms per second after it was measured`);
  stream(playout, { fromMs: 13000, forMs: 5000, frameMs: 100 });
  assert.ok(Math.abs(playout.offsetMs - before - 20) <= 0.1, `${playout.offsetMs - before}`);
});

test("half of a large error is corrected at once, every half second", () => {
  const playout = new Playout();
  stream(playout, { forMs: 10000 });
  const beforeMs = playout.delayMs;
  stream(playout, { fromMs: 10000, forMs: 500, frameMs: 200 });
  assert.ok(playout.delayMs - beforeMs <= 70, `${playout.delayMs}: at most half of the error`);
  stream(playout, { fromMs: 10500, forMs: 20000, frameMs: 200 });
  assert.ok(Math.abs(playout.delayMs - beforeMs - 120) <= 5, `${playout.delayMs}`);
});

test("a burst after a network stall does not leave a lasting delay", () => {
  const playout = new Playout();
  stream(playout, { forMs: 4000 });
  const beforeMs = playout.delayMs;
  for (let ms = 4000; ms < 5000; ms += FRAME_MS) {
    playout.soundArrived(5000, ms * SAMPLES_PER_MS, FRAME_MS * SAMPLES_PER_MS);
    playout.frameArrived(5000, (ms - 60) * SAMPLES_PER_MS);
  }
  stream(playout, { fromMs: 5000, forMs: 2000 });
  assert.ok(Math.abs(playout.delayMs - beforeMs) <= 30, `${playout.delayMs}`);
  stream(playout, { fromMs: 7000, forMs: 3000, clockMs: 5000 }); // the sender paused
  assert.ok(Math.abs(playout.delayMs - beforeMs) <= 30, `${playout.delayMs}`);
});

test("after a stall, the page is live within a second, however fast the delayed data arrives", () => {
  for (const burstMs of [1, 100, 200, 400]) {
    for (const isAudible of [true, false]) {
      const playout = new Playout();
      playout.isAudible = isAudible;
      stream(playout, { forMs: 5000 });
      const beforeMs = playout.offsetMs;
      const arriveMs = (ms) => Math.max(ms, 8000 + ((ms - 5000) / 3000) * burstMs); // of a chunk
      for (let ms = 5000; ms < 9000; ms += FRAME_MS) {
        const nowMs = arriveMs(ms + FRAME_MS);
        playout.soundArrived(nowMs, ms * SAMPLES_PER_MS, FRAME_MS * SAMPLES_PER_MS);
        playout.frameArrived(nowMs, (ms - 60) * SAMPLES_PER_MS);
        playout.adjust(nowMs);
      }
      const lateMs = playout.offsetMs - beforeMs;
      assert.ok(Math.abs(lateMs) <= 60, `${lateMs} ms after ${burstMs} ms, ${isAudible}`);
    }
  }
});

/**
 * Let sound arrive in chunks of chunkMs, each within a share of its duration, and let the sender pause for
 * pauseMs after half of the time. Return how much sound is not played, ms, after the first 5 s and 4 chunks.
 */
function streamChunks(playout, { chunkMs, share, forMs, pauseMs = 0 }) {
  const arrivals = []; // [ms, media ms]
  for (let startMs = 0; startMs < forMs; startMs += chunkMs) {
    const pausedMs = startMs > forMs / 2 ? pauseMs : 0;
    for (let ms = startMs; ms < startMs + chunkMs; ms += FRAME_MS) {
      arrivals.push([startMs + chunkMs + share * (ms - startMs) + pausedMs, ms]);
    }
  }
  const unplayed = new Set();
  let numArrived = 0;
  for (let nowMs = 0; nowMs < forMs + pauseMs; nowMs += FRAME_MS / 2) {
    for (; arrivals[numArrived]?.[0] <= nowMs; numArrived++) {
      const ms = arrivals[numArrived][1];
      playout.soundArrived(nowMs, ms * SAMPLES_PER_MS, FRAME_MS * SAMPLES_PER_MS);
      if (ms >= 60) playout.frameArrived(nowMs, (ms - 60) * SAMPLES_PER_MS);
      if (ms >= Math.max(5000, 4 * chunkMs)) unplayed.add(ms);
    }
    playout.adjust(nowMs);
    const mediaMs = playout.mediaAt(nowMs) / SAMPLES_PER_MS;
    unplayed.delete(Math.floor(mediaMs / FRAME_MS) * FRAME_MS);
  }
  const endMs = playout.mediaAt(forMs + pauseMs) / SAMPLES_PER_MS - FRAME_MS;
  return FRAME_MS * [...unplayed].filter((ms) => ms < endMs).length;
}

test("sound that arrives in long chunks is played from their start", () => {
  for (const chunkMs of [20, 200, 300, 600, 640, 800, 1000, 2000]) {
    for (const share of [0.02, 0.2, 0.4]) {
      for (const pauseMs of [0, 200, 400, 3000]) {
        const playout = new Playout();
        const lostMs = streamChunks(playout, { chunkMs, share, pauseMs, forMs: 40000 });
        const limitMs = chunkMs > 1000 ? 700 : 40; // a chunk that is longer than the offset is held
        assert.ok(lostMs <= limitMs, `${lostMs} ms of chunks of ${chunkMs} ms, ${share}, ${pauseMs}`);
        const lastMs = playout.delayMs - chunkMs;
        assert.ok(lastMs < 200, `${playout.delayMs}: much longer than the chunks of ${chunkMs} ms`);
      }
    }
  }
});

test("a machine that stalls often is not taken for a sender of long chunks", () => {
  const playout = new Playout();
  stream(playout, { forMs: 5000 });
  const beforeMs = playout.delayMs;
  for (let startMs = 5000; startMs < 20000; startMs += 2000) {
    const endMs = startMs + 600; // of a stall
    for (let ms = startMs; ms < endMs; ms += FRAME_MS) {
      playout.soundArrived(endMs, ms * SAMPLES_PER_MS, FRAME_MS * SAMPLES_PER_MS);
      playout.frameArrived(endMs, (ms - 60) * SAMPLES_PER_MS);
    }
    stream(playout, { fromMs: endMs, forMs: 1400 });
    assert.ok(Math.abs(playout.delayMs - beforeMs) <= 30, `${playout.delayMs}`);
  }
});

test("another session starts without the delay of long chunks", () => {
  const playout = new Playout();
  streamChunks(playout, { chunkMs: 1000, share: 0.2, forMs: 10000 });
  playout.reset();
  stream(playout, { clockMs: 10000, forMs: 1000 });
  assert.ok(playout.delayMs <= 120, `${playout.delayMs}`);
});

test("faces between two frames are interpolated", () => {
  const track = new FapTrack();
  const out = new Float32Array(2);
  assert.equal(track.sample(0, out), null);
  assert.equal(track.push(320, Float32Array.of(7, 7)), true);
  assert.equal(track.push(320, Float32Array.of(10, 0)), false, "it replaces the last one");
  assert.equal(track.push(160, Float32Array.of(3, 3)), false, "older frames are ignored");
  track.push(640, Float32Array.of(20, 100));
  assert.equal(track.sample(400, out), 400);
  assert.deepEqual([...out], [12.5, 25]);
  assert.equal(track.sample(0, out), 320);
  assert.deepEqual([...out], [10, 0], "before the first frame");
  assert.equal(track.sample(9999, out), 640);
  assert.deepEqual([...out], [20, 100], "after the last frame");
});
