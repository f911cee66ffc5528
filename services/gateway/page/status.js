// What the page says about its state. Pure code: nothing is written to the page here.

/** Return the kind of state, for the light beside it: "lost", "waiting" or "live". */
export function stateKind({ connected, isLive }) {
  if (!connected) return "lost";
  return isLive ? "live" : "waiting";
}

/** Return the words for a state; delayMs, if not null, is measured from the voice to the picture. */
export function stateText({ connected, session, isLive, delayMs }) {
  if (!connected) return "connecting … 连接中";
  if (session === null) return "waiting for speech 等待语音";
  if (!isLive) return "paused 暂停";
  return delayMs === null ? "live 直播" : `live 直播 · ${Math.round(delayMs / 10) * 10} ms`;
}

/** Return what to do about services that do not run; "" if none is missing. */
export function missingHint(missing) {
  if (missing.length === 0) return "";
  const isControl = missing[0] === "control";
  const start = isControl ? "kouxing run" : missing.map((name) => `kouxing ${name}`).join("; ");
  return `no ${missing.join(", no ")} is running; start: ${start}`;
}
