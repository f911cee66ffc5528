// Follows the face of a session.
//
// usage: node follow.mjs [SESSION [CONTROL-ADDRESS]]
// (default: the newest session, $KOUXING_CONTROL or tcp://127.0.0.1:5550)
//
// Prints a line per frame, 50 per second: the time of its sound and the opening of the jaw, one of
// ARKit's 52 weights. It waits for a session, follows it to other hosts, and ends with the session.
// proto/PROTOCOL.md describes all messages and lists the names of the weights.

import { setTimeout as sleep } from "node:timers/promises";
import { ask, connectControl, fail, read, subscribe } from "./kouxing.mjs";

const JAW_OPEN = 24; // index in ARKit's names
const LAST_FRAMES_MS = 500; // time for the last frames of a session that control has closed
const [sessionName = "", controlAddress] = process.argv.slice(2);

/** Return whether a frame is newer than another. After a move some frames arrive twice. */
function isNewer(frame, other) {
  return frame.media_time > other.media_time
    || (frame.media_time === other.media_time && frame.sequence > other.sequence);
}

/** Wait for the named session, or for any session; return it, or the newest. */
async function findSession(control) {
  let isWaiting = false;
  for (;;) {
    const [, { sessions = [] }] = await ask(control, "status-request", sessionName); // an error has no sessions
    const open = sessions.filter(({ endpoints }) => "faps" in endpoints);
    if (open.length > 0) return open.reduce((a, b) => (a.age_s < b.age_s ? a : b));
    if (!isWaiting) console.error(`waiting for ${sessionName || "a session"}`);
    isWaiting = true;
    await sleep(500);
  }
}

/** Print a session's frames from one publisher until they end. */
async function follow(endpoint) {
  const face = subscribe(endpoint, session, ["fap-frame", "end-of-faps", "joined"]); // joined last: no frame is missed
  for await (const message of face) {
    const [kind, body] = read(message);
    if (kind === "end-of-faps" && body.epoch >= epoch) process.exit();
    if (kind === "joined" && newest.media_time < 0) {
      await ask(control, "set-face", session, { face: { shapes: ["arkit"] } });
      console.log("following", session);
      face.unsubscribe(`joined/${session}/`); // it arrives for every subscriber that joins
    } else if (body.shapes?.arkit && isNewer(body, newest)) {
      newest = body;
      const weights = new Float32Array(new Uint8Array(body.shapes.arkit).buffer); // 52
      console.log((body.media_time / 16000).toFixed(3), weights[JAW_OPEN].toFixed(2));
    }
  }
}

const control = connectControl(controlAddress);
const { session, session_id: sessionId, endpoints } = await findSession(control);
const [, { services }] = await ask(control, "status-request", "");
const { events } = services.find(({ service }) => service === "control").endpoints;
const changes = subscribe(events, session, ["session-moved", "event"]);

let epoch = 0;
let newest = { media_time: -1, sequence: 0 };
let publisher = endpoints.faps;
follow(publisher);
for await (const message of changes) {
  const [kind, change] = read(message);
  if (change.session_id !== sessionId) continue; // of an earlier session with this name
  if (kind === "event") {
    if (change.name === "session-closed") setTimeout(fail, LAST_FRAMES_MS, `control has closed the session: ${change.detail}`);
    continue;
  }
  ({ epoch } = change);
  if (change.faps !== publisher) follow(publisher = change.faps);
}
