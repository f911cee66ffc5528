// Copies what the package shares with the gateway's page, which is where these modules stand.

import { cp, mkdir } from "node:fs/promises";

const SHARED = [
  ...["joints", "link", "messages", "morph", "pace", "pictures", "playout", "presence", "recent"],
  ...["sound", "sound-worklet"],
];
const PAGE = new URL("../../services/gateway/page/", import.meta.url);
const COPY = new URL("page/", import.meta.url);

await mkdir(COPY, { recursive: true });
for (const name of SHARED) await cp(new URL(`${name}.js`, PAGE), new URL(`${name}.js`, COPY));
