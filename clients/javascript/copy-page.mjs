// Copies the modules that the package shares with the gateway's page. A copy outside a checkout keeps its own.

import { existsSync } from "node:fs";
import { cp, mkdir } from "node:fs/promises";

const SHARED = [
  ...["draw-rate", "joints", "lateness", "morph", "player", "playout", "sliding-window"],
  ...["sound", "sound-worklet", "stream-activity", "viewer-socket"],
];
const PAGE = new URL("../../services/gateway/page/", import.meta.url);
const COPY = new URL("page/", import.meta.url);

if (existsSync(PAGE)) {
  await mkdir(COPY, { recursive: true });
  for (const name of SHARED) await cp(new URL(`${name}.js`, PAGE), new URL(`${name}.js`, COPY));
} else if (!existsSync(COPY)) {
  throw new Error("the modules of the page are missing; install the package from a checkout of kouxing");
}
