// Client for kouxing's gateway, for browsers and Node 22 or newer.

export { FapTrack, Playout } from "./page/playout.js";
export { readRecording } from "./recording.js";
export { Speaker } from "./speaker.js";
export { Viewer } from "./viewer.js";
