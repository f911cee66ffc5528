// What the page says about its state. Pure code: nothing is written to the page here.

/** Return the kind of state, for the light beside it: "lost", "waiting" or "live". */
export function stateKind({ connected, isLive }) {
  if (!connected) return "lost";
  return isLive ? "live" : "waiting";
}

/**
 * Return the words for a state; isInterrupted: our microphone was live and is to be; delayMs, if not
 * null, is measured from the voice to the picture.
 */
export function stateText({ connected, isLive, isInterrupted, delayMs }) {
  if (!connected) return "connecting … 连接中";
  if (!isLive) return isInterrupted ? "interrupted 中断" : "waiting for speech 等待语音";
  return delayMs === null ? "live 直播" : `live 直播 · ${Math.round(delayMs / 10) * 10} ms`;
}

/** Return what does not work and what happens next; "" if all is well. */
export function hint({ connected, wasConnected, isMicrophoneInterrupted, missing }) {
  if (!connected && wasConnected) {
    return "The gateway stopped. This page goes on by itself when it runs again (kouxing run).";
  }
  if (connected && missing.length > 0) return missingHint(missing);
  if (isMicrophoneInterrupted) return "The microphone was interrupted. It goes on by itself.";
  return "";
}

function missingHint(missing) {
  if (missing[0] === "control") {
    return "Control does not run. All goes on by itself when it does (kouxing run).";
  }
  const services = missing.join(" and the ");
  const commands = missing.map((name) => `kouxing ${name}`).join("; ");
  const verb = missing.length > 1 ? "do" : "does";
  return `The ${services} ${verb} not run. Under kouxing run it starts again by itself; otherwise: ${commands}`;
}
