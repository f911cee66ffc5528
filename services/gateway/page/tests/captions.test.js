import assert from "node:assert/strict";
import test from "node:test";
import { LevelMeter, rms, SILENT_DB } from "../level.js";
import { PhoneTrack } from "../phones.js";
import { Presence } from "../presence.js";
import { delayText, drawingText, hint, stateKind, stateText, turnText, waitText } from "../status.js";

function track(...symbols) {
  const phones = new PhoneTrack();
  symbols.forEach((symbol, index) => {
    phones.accept({ index, symbol, media_time: 1600 * index, duration: 1600 });
  });
  return phones;
}

test("the phone of a media time is shown with those before it", () => {
  const phones = track("sil", "n", "i", "h", "ao");
  assert.deepEqual(phones.at(-1), { current: "", past: [] });
  assert.deepEqual(phones.at(0), { current: "", past: ["·"] });
  assert.deepEqual(phones.at(3300), { current: "i", past: ["·", "n"] });
});

test("a phone can be revised", () => {
  const phones = track("n", "i");
  phones.accept({ index: 1, symbol: "v", media_time: 1600, duration: 800 });
  assert.deepEqual(phones.at(1700), { current: "v", past: ["n"] });
});

test("a phone can be withdrawn", () => {
  const phones = track("n", "i", "u");
  phones.accept({ index: 1, symbol: "sil", media_time: 1600, duration: 0, final: true });
  phones.accept({ index: 9, symbol: "sil", media_time: 1600, duration: 0, final: true });
  assert.deepEqual(phones.at(3300), { current: "u", past: ["n"] });
});

test("the last phone is shown for a while, then it is past", () => {
  const phones = track("n", "i");
  assert.equal(phones.at(3200 + 8 * 16000).current, "i");
  assert.deepEqual(phones.at(3201 + 8 * 16000), { current: "", past: ["n", "i"] });
});

test("only the newest phones are kept and shown", () => {
  const phones = track(...Array.from({ length: 200 }, (_, i) => `p${i}`));
  const { current, past } = phones.at(199 * 1600);
  assert.equal(current, "p199");
  assert.deepEqual(past, ["p191", "p192", "p193", "p194", "p195", "p196", "p197", "p198"]);
  assert.deepEqual(phones.at(99 * 1600).past, []);
});

test("the level is that of the sound that is due", () => {
  const meter = new LevelMeter();
  meter.push(320, Int16Array.of(16384, -16384));
  meter.advance(319, true);
  assert.equal(meter.decibels(), SILENT_DB);
  meter.advance(320, true);
  assert.ok(Math.abs(meter.decibels() + 6.02) < 0.01);
  assert.ok(meter.decibels() < -6.9, "it falls");
});

test("sound that is not to be shown leaves the level alone", () => {
  const meter = new LevelMeter();
  meter.push(0, Int16Array.of(16384));
  meter.advance(0, false);
  assert.equal(meter.decibels(), SILENT_DB);
  meter.raise(1);
  assert.ok(Math.abs(meter.decibels()) < 0.01);
});

test("the root mean square of full scale is 1", () => {
  assert.equal(rms(Int16Array.of(-32768, -32768)), 1);
});

test("the face comes with frames, goes to rest when they stall", () => {
  const presence = new Presence();
  presence.update(0, false);
  let share = 0;
  for (let ms = 16; ms <= 1000; ms += 16) {
    presence.frameArrived(ms);
    share = presence.update(ms, true);
  }
  assert.equal(share, 1);
  for (let ms = 1016; ms <= 1480; ms += 16) share = presence.update(ms, true);
  assert.equal(share, 1, "not yet a stall");
  for (let ms = 1496; ms <= 2600; ms += 16) share = presence.update(ms, true);
  assert.equal(share, 0);
});

test("that the page was busy is no stall", () => {
  const presence = new Presence();
  presence.update(0, true);
  presence.frameArrived(0);
  presence.soundArrived(0);
  presence.update(5000, true);
  assert.ok(presence.isLive(5000));
});

test("an idle face without sound is not live", () => {
  const presence = new Presence();
  for (let ms = 0; ms <= 1000; ms += 20) {
    presence.frameArrived(ms);
    presence.soundArrived(ms);
    presence.update(ms, true);
  }
  assert.ok(presence.isLive(1900));
  for (let ms = 1000; ms <= 3000; ms += 20) {
    presence.frameArrived(ms);
    presence.update(ms, true);
  }
  assert.ok(!presence.isLive(3000));
});

test("the state is told in words, with the delay beside it", () => {
  const state = { connected: true, isLive: true, isInterrupted: true };
  assert.equal(stateText(state), "live");
  assert.equal(stateText({ ...state, isLive: false }), "interrupted");
  assert.equal(stateText({ ...state, isLive: false, isInterrupted: false }), "waiting for speech");
  assert.equal(stateText({ ...state, connected: false }), "connecting …");
  assert.equal(stateKind(state), "live");
  assert.equal(stateKind({ ...state, isLive: false }), "waiting");
  assert.equal(stateKind({ ...state, connected: false }), "lost");
  assert.deepEqual([delayText(null, null), delayText(123.4, 200)], ["", "120 ms"]);
  assert.equal(delayText(null, 161), "sound waits 160 ms");
  assert.equal(waitText(161, null), "");
  assert.match(waitText(161, 94), /waits 160 ms .* delay=90\./);
});

test("what does not work is named with what happens next", () => {
  const well = { connected: true, wasConnected: true, isMicrophoneInterrupted: false, missing: [] };
  assert.equal(hint(well), "");
  assert.match(hint({ ...well, connected: false }), /gateway stopped/);
  assert.equal(hint({ ...well, connected: false, wasConnected: false }), "", "it only begins");
  const refused = { ...well, connected: false, wasConnected: false, isRefused: true };
  assert.match(hint(refused), /with its #token/);
  assert.match(hint({ ...well, missing: ["control"] }), /Control does not run.*kouxing run/);
  assert.match(
    hint({ ...well, missing: ["recognizer", "synthesizer"] }),
    /recognizer and the synthesizer do not run.*kouxing recognizer; kouxing synthesizer/,
  );
  assert.match(hint({ ...well, isMicrophoneInterrupted: true }), /microphone was interrupted/);
});

test("it says how coarsely it draws", () => {
  const drawing = { isCoarse: true, width: 550, height: 400 };
  assert.match(drawingText(drawing), /without a graphics card.*550 × 400/);
  assert.equal(drawingText({ ...drawing, isCoarse: false }), "");
});

test("it says how far the head is turned", () => {
  assert.equal(turnText({ left: 0.2, up: -0.3 }), "from the front");
  assert.equal(turnText({ left: -20, up: 10 }), "turned 20° to the right, 10° up");
  assert.equal(turnText({ left: 69, up: -9.8 }), "turned 69° to the left, 10° down");
});
