// The dialog "Learn my mouth" keeps the focus and releases the camera. Browser parts are fakes.

import assert from "node:assert/strict";
import test from "node:test";

const elements = {};
let trackerFrame = null; // the newest frame of a face tracker
let focused = null; // step of the section that has the focus
const sections = ["intro", "reading", "learning", "result", "problem"].map((step) => ({
  dataset: { step },
  focus: () => (focused = step),
}));
const makeElement = () => ({
  classList: { remove() {} },
  dataset: {},
  querySelectorAll: (selector) => (selector === "section" ? sections : []),
  close() {
    this.open = false;
    this.onclose();
  },
  showModal() {
    this.open = true;
  },
  play: async () => {},
  requestVideoFrameCallback() {},
});
globalThis.document = {
  documentElement: { lang: "en" },
  body: { append() {} },
  createElement: () => (trackerFrame = { contentWindow: {}, remove() {} }),
  getElementById: (id) => (elements[id] ??= makeElement()),
};
const { translate } = await import("../../services/gateway/page/language.js");
const { LearnMouthDialog } = await import("../../services/gateway/page/learn-mouth.js");

/** Open the dialog and start a recording; return the dialog element and allow(), which grants the camera. */
function startRecording() {
  let allow;
  const permission = new Promise((resolve) => (allow = resolve));
  Object.defineProperty(globalThis, "navigator", {
    value: { mediaDevices: { getUserMedia: () => permission } },
    configurable: true,
  });
  globalThis.AudioContext = class {
    audioWorklet = { addModule: async () => {} };
    async close() {}
  };
  globalThis.addEventListener = (_, receive) => (trackerFrame.receive = receive);
  globalThis.removeEventListener = () => {};
  const dialog = new LearnMouthDialog({ current: null }, { opened() {}, closed() {}, profileChanged() {} });
  dialog.open();
  elements["learn-start"].onclick();
  return { dialog: elements["learn-mouth"], allow };
}

function makeCamera() {
  const camera = { isOn: true, stop: () => (camera.isOn = false) };
  return { camera, stream: { getTracks: () => [camera] } };
}

const settle = () => new Promise((resolve) => setImmediate(resolve));

test("a dialog that is closed before the camera is allowed leaves the camera off", async () => {
  const { dialog, allow } = startRecording();
  const { camera, stream } = makeCamera();
  dialog.close();
  allow(stream);
  await settle();
  assert.ok(!camera.isOn);
});

test("a dialog that is closed while the tracker loads turns the camera off at once", async () => {
  const { dialog, allow } = startRecording();
  const { camera, stream } = makeCamera();
  allow(stream);
  await settle();
  assert.ok(camera.isOn);
  dialog.close();
  assert.ok(!camera.isOn);
});

test("a recording ends with the reason if the page is hidden, because its camera then takes no images", async () => {
  const { allow } = startRecording();
  const { camera, stream } = makeCamera();
  allow(stream);
  await settle();
  trackerFrame.receive({ source: trackerFrame.contentWindow, data: { lips: [] } });
  await settle();
  globalThis.document.hidden = true;
  globalThis.document.onvisibilitychange();
  await settle();
  assert.equal(elements["learn-problem"].textContent, translate("learnHidden"));
  assert.ok(!camera.isOn);
  assert.equal(globalThis.document.onvisibilitychange, null);
});

test("the focus moves to the step that is shown", () => {
  startRecording();
  assert.equal(focused, "reading");
});
