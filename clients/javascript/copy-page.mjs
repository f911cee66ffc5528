// Copies the modules that the package shares with the gateway's page.

import { cp, mkdir } from "node:fs/promises";

const SHARED = [
  ...["draw-rate", "joints", "lateness", "messages", "morph", "player", "playout", "sliding-window"],
  ...["sound", "sound-worklet", "stream-activity", "viewer-socket"],
];
const PAGE = new URL("../../services/gateway/page/", import.meta.url);
const COPY = new URL("page/", import.meta.url);

await mkdir(COPY, { recursive: true });
for (const name of SHARED) await cp(new URL(`${name}.js`, PAGE), new URL(`${name}.js`, COPY));
