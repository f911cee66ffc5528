import assert from "node:assert/strict";
import test from "node:test";

import { isOff, senderText } from "../programs.js";

test("a sender says what it sends and how often, or what keeps it from that", () => {
  const sender = { contents: "VRM shapes", rate_hz: 49.8, delay_ms: 0, problem: "" };
  assert.equal(senderText(sender), "VRM shapes, 50 frames/s");
  assert.equal(senderText({ ...sender, delay_ms: 90 }), "VRM shapes, 50 frames/s, 90 ms later");
  assert.equal(senderText({ ...sender, problem: "no program listens" }), "no program listens");
});

test("a delay is offered while there is sound that a program does not fit", () => {
  const [now, later] = [{ delay_ms: 0 }, { delay_ms: 90 }];
  assert.equal(isOff([now], null), false);
  assert.equal(isOff([], 90), false);
  assert.equal(isOff([later], 100), false);
  assert.equal(isOff([later, now], 90), true);
});
