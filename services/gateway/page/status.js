// What the page says about its state. Pure code: nothing is written to the page here.

import { say } from "./language.js";

/** Return the kind of state, for the light beside it: "lost", "waiting" or "live". */
export function stateKind({ connected, isLive }) {
  if (!connected) return "lost";
  return isLive ? "live" : "waiting";
}

/** Return the words for a state; isInterrupted: our microphone was live and is to be. */
export function stateText({ connected, isLive, isInterrupted }) {
  if (!connected) return say({ en: "connecting …", zh: "连接中…" });
  if (isLive) return say({ en: "live", zh: "直播" });
  return isInterrupted ? say({ en: "interrupted", zh: "中断" }) : say({ en: "waiting for speech", zh: "等待语音" });
}

/**
 * Return the words for the delay from the own voice to the picture, or else for how long sound waits
 * for its picture, ms; "" while neither is known.
 */
export function delayText(voiceMs, soundMs) {
  if (voiceMs !== null) return `${tens(voiceMs)} ms`;
  if (soundMs === null) return "";
  return say({ en: `sound waits ${tens(soundMs)} ms`, zh: `声音延迟 ${tens(soundMs)} ms` });
}

/** Return the words for how long sound, and a frame, wait for their picture, ms; "" while unknown. */
export function waitText(soundMs, frameMs) {
  if (soundMs === null || frameMs === null) return "";
  return say({
    en: `Sound waits ${tens(soundMs)} ms for its picture. Another program's face fits this sound if its sender has delay=${tens(frameMs)}.`,
    zh: `声音等画面 ${tens(soundMs)} ms。要让其他程序的脸与此声音同步，发送地址加 delay=${tens(frameMs)}。`,
  });
}

/** Round to tens: what is shown changes with every frame, and nobody sees a few milliseconds. */
export function tens(ms) {
  return Math.round(ms / 10) * 10;
}

/** Return the words for how the head is drawn (Head.drawing); "" if as well as it can be. */
export function drawingText({ isCoarse, width, height }) {
  if (!isCoarse) return "";
  const size = `${width} × ${height}`;
  return say({
    en: `Drawn without a graphics card, so with fewer triangles and pixels: ${size}`,
    zh: `没有显卡，画面已简化：${size} 像素`,
  });
}

/** Return the words for how far the head is turned in the picture, degrees. */
export function turnText(turned) {
  const [left, up] = [turned.left, turned.up].map(Math.round);
  if (left === 0 && up === 0) return say({ en: "from the front", zh: "正面" });
  const sides = [
    [left, { en: "to the left", zh: "向左" }],
    [-left, { en: "to the right", zh: "向右" }],
    [up, { en: "up", zh: "向上" }],
    [-up, { en: "down", zh: "向下" }],
  ];
  const parts = sides
    .filter(([degrees]) => degrees > 0)
    .map(([degrees, { en, zh }]) => say({ en: `${degrees}° ${en}`, zh: `${zh} ${degrees}°` }));
  return say({ en: `turned ${parts.join(", ")}`, zh: parts.join("，") });
}

/**
 * Return what does not work and what happens next; "" if all is well. isRefused: it never connected,
 * though the gateway served this page.
 */
export function hint({ connected, wasConnected, isRefused, isMicrophoneInterrupted, missing }) {
  if (!connected && wasConnected) {
    return say({
      en: "The gateway stopped. This page goes on by itself when it runs again (kouxing run).",
      zh: "网关已停止。重新运行（kouxing run）后，本页会自动恢复。",
    });
  }
  if (isRefused) {
    return say({
      en: "No connection. Open the whole address that kouxing run shows, with its #token=… if it has one.",
      zh: "无法连接。请打开 kouxing run 显示的完整地址（如有 #token=… 也要包含）。",
    });
  }
  if (connected && missing.length > 0) return missingHint(missing);
  if (isMicrophoneInterrupted) {
    return say({
      en: "The microphone was interrupted. It goes on by itself.",
      zh: "麦克风中断，会自动恢复。",
    });
  }
  return "";
}

function missingHint(missing) {
  if (missing[0] === "control") {
    return say({
      en: "Control does not run. All goes on by itself when it does (kouxing run).",
      zh: "控制服务（control）没有运行。运行 kouxing run 后会自动恢复。",
    });
  }
  const verb = missing.length > 1 ? "do" : "does";
  const commands = missing.map((name) => `kouxing ${name}`).join("; ");
  return say({
    en:
      `The ${missing.join(" and the ")} ${verb} not run. Under kouxing run it starts again by itself; ` +
      `otherwise: ${commands}`,
    zh: `${missing.join("、")} 没有运行。用 kouxing run 时会自动重启；否则请运行：${commands}`,
  });
}

// What services refuse, by the code of the error; the English text says more.
const REFUSALS = {
  "bad-audio": "音频有误",
  busy: "人太多了：请稍后再试",
  "bad-voice": "学到的口型不适用于当前版本：请重新“学我的口型”",
  "no-service": "缺少服务：请运行 kouxing run",
  "session-exists": "同名会话已存在",
  "too-many-sessions": "会话太多：请先关闭一些",
  "unknown-session": "会话已不存在",
  timeout: "服务没有及时应答：请重试",
};

/** Return the words for an error that came over the wire. */
export function errorText({ code, text }) {
  if (code === "bad-voice") {
    text = "What was learnt of your mouth does not fit this version: press Learn my mouth.";
  }
  const zh = REFUSALS[code] ? `${REFUSALS[code]}（${text}）` : text;
  return say({ en: text, zh });
}
