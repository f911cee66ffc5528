// The service worker of the demo page. The browser's parts are fakes.

import assert from "node:assert/strict";
import { readFile } from "node:fs/promises";
import test from "node:test";
import { runInNewContext } from "node:vm";

const PAGE = "https://example.org/demo/";
const source = await readFile(new URL("../demo/service-worker.js", import.meta.url), "utf8");

/** Request a file that is not cached; return its status and the cached URLs. */
async function request(status) {
  const cached = [];
  const cache = {
    match: async () => undefined,
    async put({ url }, response) {
      if (response.status === 206) throw new TypeError("Partial response (status code 206) is unsupported");
      cached.push(url);
    },
  };
  const handlers = {};
  const self = { registration: { scope: PAGE }, addEventListener: (type, handle) => (handlers[type] = handle) };
  const fetch = async () => new Response(status === 404 ? "" : "file", { status });
  runInNewContext(source, { self, caches: { open: async () => cache }, fetch, VERSION: "1", FILES: [] });
  let answer;
  handlers.fetch({ request: { method: "GET", url: `${PAGE}sample.wav` }, respondWith: (response) => (answer = response) });
  return { status: (await answer).status, cached };
}

test("a file is cached, but neither a part of it nor an error", async () => {
  assert.deepEqual(await request(200), { status: 200, cached: [`${PAGE}sample.wav`] });
  assert.deepEqual(await request(206), { status: 206, cached: [] });
  assert.deepEqual(await request(404), { status: 404, cached: [] });
});
