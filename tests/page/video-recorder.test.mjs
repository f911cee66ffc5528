// Videos of the face. The browser's recorder is a fake.

import assert from "node:assert/strict";
import test from "node:test";
import { VideoRecorder } from "../../services/gateway/page/video-recorder.js";

const canvas = { captureStream: () => ({ getTracks: () => [] }) };

class FakeSound {
  numTaps = 0;
  async tap() {
    this.numTaps++;
    return { getTracks: () => [] };
  }
  untap() {
    this.numTaps--;
  }
}

test.beforeEach(() => {
  globalThis.MediaStream = class {};
  globalThis.MediaRecorder = class {
    static isTypeSupported = (type) => type === "video/webm";
    start() {}
    stop() {
      this.ondataavailable({ data: "video" });
      this.onstop();
    }
  };
});

test("a video has the data until the recorder is stopped", async () => {
  const sound = new FakeSound();
  const recorder = new VideoRecorder(sound);
  const videos = [];
  const start = () => recorder.start(canvas, (video) => videos.push(video));
  await Promise.all([start(), start()]); // two clicks
  assert.ok(recorder.isRecording);
  assert.equal(sound.numTaps, 1);
  recorder.stop();
  assert.ok(!recorder.isRecording);
  assert.equal(videos.length, 1);
  assert.deepEqual([videos[0].type, await videos[0].text()], ["video/webm", "video"]);
  assert.equal(sound.numTaps, 0);
});

test("it can be started again after the browser's recorder has failed", async () => {
  const sound = new FakeSound();
  const recorder = new VideoRecorder(sound);
  globalThis.MediaRecorder.prototype.start = () => {
    throw new Error("no encoder");
  };
  await assert.rejects(recorder.start(canvas), /no encoder/);
  assert.ok(!recorder.isRecording);
  assert.equal(sound.numTaps, 0);
  globalThis.MediaRecorder.prototype.start = () => {};
  await recorder.start(canvas);
  assert.ok(recorder.isRecording);
});
