import assert from "node:assert/strict";
import test from "node:test";
import { GatewayState } from "../../services/gateway/page/gateway-state.js";

const SESSION = { session: "one", epoch: 1, sample: false, lips: "learnt" };

test("a greater epoch of the same session is a restart", () => {
  const state = new GatewayState();
  assert.deepEqual(state.setSession(SESSION), { isOther: true, isRestart: false });
  assert.deepEqual(state.setSession({ ...SESSION, epoch: 2 }), { isOther: false, isRestart: true });
  assert.deepEqual(state.setSession({ ...SESSION, session: "two" }), { isOther: true, isRestart: false });
});

test("the lips of a session that has ended stay known", () => {
  const state = new GatewayState();
  state.setSession(SESSION);
  state.setSession({ session: null, epoch: 0, sample: false, lips: "" });
  assert.deepEqual([state.session, state.lips], [null, "learnt"]);
});

test("a failed first connection counts as refused", () => {
  const state = new GatewayState();
  state.setConnected(false);
  assert.deepEqual([state.isRefused, state.wasConnected], [true, false]);
  state.setConnected(true);
  state.setSession(SESSION);
  state.setConnected(false);
  assert.deepEqual([state.isRefused, state.wasConnected, state.session], [false, true, null]);
});
