// Client for kouxing's gateway, for browsers and Node 22 or newer.

export { NUM_FAPS, readMessage } from "./page/messages.js";
export { FapTrack, Playout } from "./page/playout.js";
export { readRecording } from "./recording.js";
export { Speaker } from "./speaker.js";
export { Viewer } from "./viewer.js";
