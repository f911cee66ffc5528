import assert from "node:assert/strict";
import test from "node:test";

import { isOutOfSync, senderText } from "../../services/gateway/page/senders-panel.js";

test("the state of a sender is its contents and rate, or its problem", () => {
  const sender = { contents: "VRM shapes", rate_hz: 49.8, delay_ms: 0, problem: "" };
  assert.equal(senderText(sender), "VRM shapes, 50 frames/s");
  assert.equal(senderText({ ...sender, delay_ms: 90 }), "VRM shapes, 50 frames/s, delayed 90 ms");
  assert.equal(senderText({ ...sender, problem: "no program is listening" }), "no program is listening");
});

test("a sender is out of sync if its delay differs from that of the sound", () => {
  const [now, later] = [{ delay_ms: 0 }, { delay_ms: 90 }];
  assert.equal(isOutOfSync([now], null), false);
  assert.equal(isOutOfSync([], 90), false);
  assert.equal(isOutOfSync([later], 100), false);
  assert.equal(isOutOfSync([later, now], 90), true);
});
