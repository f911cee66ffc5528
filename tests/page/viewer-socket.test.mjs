import assert from "node:assert/strict";
import test from "node:test";
import { socketUrl } from "../../services/gateway/page/address.js";
import { ViewerSocket } from "../../services/gateway/page/viewer-socket.js";

class FakeWebSocket {
  static CONNECTING = 0;
  static OPEN = 1;
  static instances = [];
  readyState = 0;
  sent = [];
  constructor(url) {
    this.url = url;
    FakeWebSocket.instances.push(this);
  }
  send(text) { this.sent.push(JSON.parse(text)); }
  close() {}
  open() {
    this.readyState = FakeWebSocket.OPEN;
    this.onopen();
  }
}

/** Return a binary message as services/gateway/messages/browser_messages.py packs it: <B3xId and the payload. */
function binary(kind, mediaTime, payload) {
  const data = new ArrayBuffer(16 + payload.byteLength);
  const header = new DataView(data);
  header.setUint8(0, kind);
  header.setUint32(4, 7, true);
  header.setFloat64(8, mediaTime, true);
  new Uint8Array(data, 16).set(new Uint8Array(payload.buffer));
  return data;
}

test.beforeEach((t) => {
  t.mock.timers.enable({ apis: ["setTimeout", "setInterval"] });
  FakeWebSocket.instances = [];
  globalThis.WebSocket = FakeWebSocket;
  globalThis.location = { protocol: "http:", host: "localhost:8080", hash: "" };
});

const toViewer = (session) => socketUrl("/viewer", { session });

function record() {
  const calls = [];
  const names = ["state", "fap", "sound", "rest", "weights", "restWeights", "text"];
  const handlers = Object.fromEntries(names.map((name) => [name, (...args) => calls.push([name, ...args])]));
  return { calls, handlers };
}

test("binary messages are read by their type; unknown types are ignored", () => {
  const { calls, handlers } = record();
  const viewer = new ViewerSocket(toViewer, "", handlers);
  const [socket] = FakeWebSocket.instances;
  const faps = Float32Array.from({ length: 68 }, (_, i) => i);
  const [samples, weights] = [Int16Array.of(1, -32768), Float32Array.of(0.5, 1)];
  socket.onmessage({ data: binary(1, 2 ** 40 + 1, faps) });
  socket.onmessage({ data: binary(2, 320, samples) });
  socket.onmessage({ data: binary(3, 0, faps) });
  socket.onmessage({ data: binary(4, 320, weights) });
  socket.onmessage({ data: binary(5, 0, weights) });
  socket.onmessage({ data: binary(6, 0, new Uint8Array(3)) });
  assert.deepEqual(calls, [
    ["fap", 2 ** 40 + 1, faps],
    ["sound", 320, samples],
    ["rest", faps],
    ["weights", 320, weights],
    ["restWeights", weights],
  ]);
  viewer.close();
});

test("it reconnects with increasing delays, to the session chosen last", (t) => {
  const { calls, handlers } = record();
  const viewer = new ViewerSocket(toViewer, "", handlers);
  FakeWebSocket.instances[0].open();
  viewer.follow("a b");
  assert.deepEqual(FakeWebSocket.instances[0].sent, [{ follow: "a b" }]);
  FakeWebSocket.instances[0].onclose();
  t.mock.timers.tick(299);
  assert.equal(FakeWebSocket.instances.length, 1);
  t.mock.timers.tick(1);
  assert.equal(FakeWebSocket.instances[1].url, "ws://localhost:8080/viewer?session=a+b");
  FakeWebSocket.instances[1].onerror(); // as in Node 22, without onclose
  t.mock.timers.tick(599);
  assert.equal(FakeWebSocket.instances.length, 2);
  t.mock.timers.tick(1);
  FakeWebSocket.instances[2].open();
  FakeWebSocket.instances[2].onclose();
  t.mock.timers.tick(300);
  assert.equal(FakeWebSocket.instances.length, 4, "a connection resets the delay");
  viewer.close();
  t.mock.timers.tick(5000);
  assert.equal(FakeWebSocket.instances.length, 4, "closed");
  const states = calls.map(([, connected]) => connected);
  assert.deepEqual(states, [true, false, false, true, false, false]);
});

test("it follows a session that was chosen while it was connecting", () => {
  const viewer = new ViewerSocket(toViewer, "old", record().handlers);
  const [socket] = FakeWebSocket.instances;
  viewer.follow("new");
  assert.deepEqual(socket.sent, []);
  socket.open();
  assert.deepEqual(socket.sent, [{ follow: "new" }]);
});

test("a command waits while it is connecting, and is dropped if that fails", (t) => {
  const viewer = new ViewerSocket(toViewer, "", record().handlers);
  viewer.send({ play: "sample" });
  FakeWebSocket.instances[0].open();
  assert.deepEqual(FakeWebSocket.instances[0].sent, [{ play: "sample" }]);
  FakeWebSocket.instances[0].onclose();
  t.mock.timers.tick(300);
  viewer.send({ play: "sample" });
  viewer.follow("new");
  FakeWebSocket.instances[1].onclose();
  t.mock.timers.tick(600);
  FakeWebSocket.instances[2].open();
  assert.equal(FakeWebSocket.instances[2].url, "ws://localhost:8080/viewer?session=new");
  assert.deepEqual(FakeWebSocket.instances[2].sent, []);
});

test("the handler of a lost connection can close it for good", (t) => {
  const { handlers } = record();
  const viewer = new ViewerSocket(toViewer, "", { ...handlers, state: (isConnected) => isConnected || viewer.close() });
  FakeWebSocket.instances[0].open();
  FakeWebSocket.instances[0].onclose();
  t.mock.timers.tick(5000);
  assert.equal(FakeWebSocket.instances.length, 1);
});

test("a connection on which nothing arrives is replaced", (t) => {
  const { calls, handlers } = record();
  const viewer = new ViewerSocket(toViewer, "", handlers);
  const [lost] = FakeWebSocket.instances;
  lost.open();
  t.mock.timers.tick(5000);
  lost.onmessage({ data: binary(3, 0, new Float32Array(68)) });
  t.mock.timers.tick(5000);
  assert.deepEqual(calls.at(-1)[0], "rest");
  t.mock.timers.tick(1000);
  assert.deepEqual(calls.at(-1), ["state", false]);
  assert.equal(lost.onmessage, null, "its old faces are not shown");
  t.mock.timers.tick(300);
  assert.equal(FakeWebSocket.instances.length, 2);
  t.mock.timers.tick(6000); // it does not connect either
  t.mock.timers.tick(600);
  assert.equal(FakeWebSocket.instances.length, 3);
  viewer.close();
});
