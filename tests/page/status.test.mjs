import assert from "node:assert/strict";
import test from "node:test";
import { LevelMeter, SILENT_DB } from "../../services/gateway/page/level.js";
import { Caption, PhoneTrack } from "../../services/gateway/page/caption.js";
import { StreamActivity } from "../../services/gateway/page/stream-activity.js";
import { errorToChinese, toChinese } from "../../services/gateway/page/gateway-texts.js";
import { isOutOfSync, senderText } from "../../services/gateway/page/senders-panel.js";
import { GatewayState } from "../../services/gateway/page/gateway-state.js";
import { PersistentFault } from "../../services/gateway/page/notice.js";
import { StatusBar, stateKey } from "../../services/gateway/page/status-bar.js";
import {
  delayText,
  drawingText,
  hintText,
  playoutDelaysText,
  secondsText,
  turnText,
} from "../../services/gateway/page/status-texts.js";

function track(...symbols) {
  const phones = new PhoneTrack();
  symbols.forEach((symbol, index) => {
    phones.add({ index, symbol, media_time: 1600 * index, duration: 1600 });
  });
  return phones;
}

test("the phone at a media time is shown with the phones before it", () => {
  const phones = track("sil", "n", "i", "h", "ao");
  assert.deepEqual(phones.at(-1), { current: "", past: [], opacity: 0 });
  assert.deepEqual(phones.at(0), { current: "", past: ["·"], opacity: 0 });
  assert.deepEqual(phones.at(3300), { current: "i", past: ["·", "n"], opacity: 1 });
  phones.add({ index: 1, symbol: "sil", media_time: 1600, duration: 0, final: true });
  assert.deepEqual(phones.at(3300).past, ["·"], "a phone was removed");
});

test("the last phone stays during a pause and then fades", () => {
  const phones = track("a", "sil");
  assert.deepEqual(phones.at(17000), { current: "a", past: [], opacity: 1 });
  assert.deepEqual(phones.at(25600), { current: "a", past: [], opacity: 0.5 });
  assert.deepEqual(phones.at(34000), { current: "", past: ["a", "·"], opacity: 0 });
});

test("a caption has the language of its session", () => {
  const elements = {};
  const makeElement = () => ({ setAttribute() {} });
  globalThis.document = { getElementById: (id) => (elements[id] ??= makeElement()) };
  const caption = new Caption({ get: () => null });
  for (const language of ["de", ""]) {
    caption.reset(language);
    assert.deepEqual([elements.spoken.lang, elements.past.lang], [language, language]);
  }
  delete globalThis.document;
});

test("the level is that of the sound that is audible", () => {
  const meter = new LevelMeter();
  meter.push(0, new Int16Array(0)); // the end of a session
  meter.push(320, Int16Array.of(16384, -16384));
  meter.advance(319, true);
  assert.equal(meter.nextDecibels(), SILENT_DB);
  meter.advance(320, true);
  assert.ok(Math.abs(meter.nextDecibels() + 6.02) < 0.01);
  assert.ok(meter.nextDecibels() < -6.9, "it falls");
});

test("the face fades in with frames and fades to rest when they stall", () => {
  const activity = new StreamActivity();
  activity.update(0, false);
  let share = 0;
  for (let ms = 16; ms <= 1000; ms += 16) {
    activity.frameArrived(ms);
    share = activity.update(ms, true);
  }
  assert.equal(share, 1);
  for (let ms = 1016; ms <= 1480; ms += 16) share = activity.update(ms, true);
  assert.equal(share, 1, "too short for a stall");
  for (let ms = 1496; ms <= 2600; ms += 16) share = activity.update(ms, true);
  assert.equal(share, 0);
  activity.frameArrived(2600);
  activity.soundArrived(2600);
  activity.update(9000, true);
  assert.ok(activity.isLive(9000), "a busy page does not count as a stall");
});

test("an idle face without sound is not live", () => {
  const activity = new StreamActivity();
  for (let ms = 0; ms <= 1000; ms += 20) {
    activity.frameArrived(ms);
    activity.soundArrived(ms);
    activity.update(ms, true);
  }
  assert.ok(activity.isLive(1900));
  for (let ms = 1000; ms <= 3000; ms += 20) {
    activity.frameArrived(ms);
    activity.update(ms, true);
  }
  assert.ok(!activity.isLive(3000));
});

test("the state is shown with the delay", () => {
  const state = { isConnected: true, isLive: true, isInterrupted: true };
  assert.equal(stateKey(state), "live");
  assert.equal(stateKey({ ...state, isBehind: true }), "behind");
  assert.equal(stateKey({ ...state, isLive: false }), "interrupted");
  assert.equal(stateKey({ ...state, isLive: false, isInterrupted: false }), "waiting");
  assert.equal(stateKey({ ...state, isConnected: false }), "disconnected");
  assert.equal(stateKey({ ...state, isConnected: false, isStarting: true }), "connecting");
  assert.equal(secondsText(1234), "1.2 s");
  assert.deepEqual([delayText(null, null), delayText(123.4, 200)], ["", "120 ms"]);
  assert.equal(delayText(null, 161), "sound delay 160 ms");
  assert.equal(playoutDelaysText(161, null), "");
  assert.match(playoutDelaysText(161, 94), /by 160 ms .* delay=90 /);
});

test("a hint names the problem and the remedy", () => {
  const well = { isConnected: true, wasConnected: true, missing: [] };
  assert.equal(hintText(well), "");
  assert.match(hintText({ ...well, isConnected: false }), /does not answer.*network.*kouxing run/);
  const starting = { ...well, isConnected: false, wasConnected: false };
  assert.equal(hintText(starting), "");
  assert.match(hintText({ ...starting, isRejected: true }), /#token/);
  assert.match(hintText({ ...well, isConnected: false, isRejected: true }), /#token/);
  assert.match(hintText({ ...well, missing: ["control"] }), /Control is not running.*kouxing run/);
  assert.match(
    hintText({ ...well, missing: ["recognizer", "synthesizer"] }),
    /recognizer, synthesizer.*kouxing recognizer; kouxing synthesizer/,
  );
});

/** Interrupt a source for 2 s; return the hint in the meantime and the toast after it. */
function interrupt(isFile) {
  const { performance } = globalThis;
  const shown = {};
  const speech = { state: "interrupted", session: "voice", microphone: { isFile } };
  const bar = new StatusBar({
    gateway: Object.assign(new GatewayState(), { isConnected: true, session: "voice" }),
    player: { activity: { isLive: () => false }, lateness: { update() {} }, playout: {}, voiceToImageMs: null },
    speech,
    sound: { state: "off" },
    notice: { showHint: (text) => (shown.hint ||= text), showToast: (text) => (shown.toast = text) },
    senders: {},
  });
  globalThis.document = { getElementById: () => ({ dataset: {} }) };
  globalThis.location = { hostname: "localhost" };
  for (const nowMs of [0, 2000, 2100]) {
    globalThis.performance = { now: () => nowMs };
    if (nowMs > 2000) speech.state = "on";
    bar.show();
  }
  Object.assign(globalThis, { performance });
  delete globalThis.document;
  delete globalThis.location;
  return shown;
}

test("the hint about an interruption names its source", () => {
  assert.match(interrupt(false).hint, /microphone/i);
  assert.match(interrupt(false).toast, /microphone/i);
  assert.match(interrupt(true).hint, /The file continues/);
  assert.equal(interrupt(true).toast, "The file is playing again.");
});

test("the light model is offered only in its language", (t) => {
  const elements = {};
  globalThis.document = { getElementById: (id) => (elements[id] ??= { dataset: {} }) };
  globalThis.location = { hostname: "localhost" };
  t.after(() => {
    delete globalThis.document;
    delete globalThis.location;
  });
  const gateway = new GatewayState();
  const bar = new StatusBar({
    gateway,
    player: { activity: { isLive: () => true }, lateness: { update() {} }, playout: {}, voiceToImageMs: null },
    speech: { state: "off", microphone: {} },
    sound: { state: "off" },
    notice: { showHint() {} },
    senders: {},
  });
  const isOffered = (language) => {
    gateway.setSession({ session: "one", epoch: 1, sample: false, lip_model: "learned", language, acoustic: "full" });
    bar.show();
    return !elements["light-model"].hidden;
  };
  assert.deepEqual(["zh", "en"].map(isOffered), [true, false]);
});

test("a rejected connection stays rejected until the page connects", () => {
  const state = new GatewayState();
  state.setConnected(true);
  state.setConnected(false);
  assert.equal(state.isRejected, false);
  state.isRejected = true;
  state.setConnected(false);
  assert.equal(state.isRejected, true);
  state.setConnected(true);
  assert.equal(state.isRejected, false);
});

test("a fault is shown after a second, and its end only if it was shown", () => {
  const fault = new PersistentFault();
  const nothing = { hint: "", isOver: false };
  assert.deepEqual(fault.update(0, "lost"), nothing);
  assert.deepEqual(fault.update(900, "lost"), nothing);
  assert.deepEqual(fault.update(950, ""), nothing);
  assert.deepEqual(fault.update(1000, "lost"), nothing);
  assert.deepEqual(fault.update(2100, "lost"), { hint: "lost", isOver: false });
  assert.deepEqual(fault.update(2200, ""), { hint: "", isOver: true });
  assert.deepEqual(fault.update(2300, ""), nothing);
});

test("texts of the gateway are translated with their values", () => {
  assert.equal(
    toChinese("a b.mp3: cannot read audio: this is text, not audio: 'x'; use an audio file"),
    "a b.mp3：无法读取声音：这是文本，不是声音：'x'；请用声音文件",
  );
  const empty = "a.wav: the file is empty; copy or record it again";
  assert.equal(toChinese(`${empty}\n1: unknown: why`), "a.wav：文件是空的，请重新复制或录制\n1：unknown：why");
  assert.equal(errorToChinese("busy", "no such text"), "系统繁忙，请稍后再试：no such text");
  assert.equal(errorToChinese("new-code", "no"), "no");
  assert.equal(
    errorToChinese(
      "no-service",
      "no recognizer is running; start one with 'kouxing recognizer' (or everything with 'kouxing run')",
    ),
    "没有运行 recognizer，请运行 kouxing recognizer（或用 kouxing run 启动全部服务）",
  );
  assert.equal(
    errorToChinese(
      "busy",
      "every recognizer is busy: a session needs 38 % of one, but at most 5 % is free; try again in 2 s",
    ),
    "所有 recognizer 都忙：需要 38% 的空闲时间，只剩 5%；请 2 秒后重试",
  );
  assert.equal(toChinese("ARKit shapes of the mouth"), "嘴部的ARKit 形状");
  assert.equal(
    toChinese("vmc://: the delay must be 0 or 1 to 10000 ms, not '0.1'; a value in seconds must be multiplied by 1000"),
    "vmc://：延迟必须是 0 或 1 到 10000 毫秒，不能是 '0.1'；以秒为单位的数请乘以 1000",
  );
  assert.equal(toChinese("vmc://: head must be on or off"), "vmc://：head 必须是 on or off");
});

test("reduced quality and the head's rotation are described", () => {
  const drawing = { isCoarse: true, width: 550, height: 400 };
  assert.match(drawingText(drawing), /No graphics card.*550 × 400/);
  assert.equal(drawingText({ ...drawing, isCoarse: false }), "");
  assert.equal(turnText({ left: 0.2, up: -0.3 }), "from the front");
  assert.equal(turnText({ left: -20, up: 10 }), "turned 20° to the right, 10° up");
  assert.equal(turnText({ left: 69, up: -9.8 }), "turned 69° to the left, 10° down");
});

test("sessions restart, end and lose their connection", () => {
  const [session, state] = [{ session: "one", epoch: 1, sample: false, lip_model: "learned" }, new GatewayState()];
  state.setConnected(false);
  assert.deepEqual([state.isRejected, state.wasConnected], [true, false], "the first connection failed");
  state.setConnected(true);
  assert.deepEqual(state.setSession(session), { isOther: true, isRestart: false });
  assert.deepEqual(state.setSession({ ...session, epoch: 2 }), { isOther: false, isRestart: true });
  assert.deepEqual(state.setSession({ ...session, session: "two" }), { isOther: true, isRestart: false });
  state.setSession({ session: null, epoch: 0, sample: false, lip_model: "" });
  assert.deepEqual([state.session, state.lipModel], [null, "learned"]);
  state.setSession(session);
  state.setConnected(false);
  assert.deepEqual([state.isRejected, state.wasConnected, state.session], [false, true, null]);
});

test("a sender shows its contents and rate, or its problem", () => {
  const sender = { contents: "VRM shapes", rate_hz: 49.8, delay_ms: 90, problem: "" };
  assert.equal(senderText(sender), "VRM shapes, 50 frames/s, delayed 90 ms");
  assert.equal(senderText({ ...sender, problem: "no program is listening" }), "no program is listening");
});

test("a sender is out of sync if its delay differs from that of the sound", () => {
  const [now, later] = [{ delay_ms: 0 }, { delay_ms: 90 }];
  assert.equal(isOutOfSync([now], null), false);
  assert.equal(isOutOfSync([], 90), false);
  assert.equal(isOutOfSync([later], 100), false);
  assert.equal(isOutOfSync([later, now], 90), true);
});
