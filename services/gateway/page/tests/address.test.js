import assert from "node:assert/strict";
import test from "node:test";
import { pathOf, socketUrl } from "../address.js";

test("the token is taken out of the address, and goes with every request", () => {
  globalThis.location = {
    protocol: "https:",
    host: "phone:8080",
    pathname: "/",
    search: "?view=bare",
    hash: "#token=a%2Bb",
  };
  let shown = null;
  globalThis.history = { replaceState: (_state, _title, address) => (shown = address) };
  assert.equal(socketUrl("/viewer", { session: "" }), "wss://phone:8080/viewer?token=a%2Bb");
  assert.equal(shown, "/?view=bare");
  globalThis.location.hash = "";
  assert.equal(pathOf("learn-mouth"), "learn-mouth?token=a%2Bb");
});
