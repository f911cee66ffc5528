// The page waits for a gateway that does not answer yet.

import assert from "node:assert/strict";
import test from "node:test";
import { loadOffers } from "../../services/gateway/page/offers.js";

test("the offers are requested again until the gateway answers", async (t) => {
  t.mock.timers.enable({ apis: ["setTimeout"] });
  const answers = [
    async () => {
      throw new TypeError("Failed to fetch");
    },
    async () => new Response("the gateway is stopping", { status: 503 }),
    async () => Response.json({ heads: ["woman"] }),
  ];
  globalThis.fetch = async () => answers.shift()();
  let numFailures = 0;
  const offers = await loadOffers(() => {
    numFailures++;
    setImmediate(() => t.mock.timers.runAll()); // after the page has started to wait
  });
  assert.deepEqual(offers, { heads: ["woman"] });
  assert.equal(numFailures, 2);
});
