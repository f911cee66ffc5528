import assert from "node:assert/strict";
import test from "node:test";
import { pathWithToken, socketUrl } from "../../services/gateway/page/address.js";

test("the token is removed from the page's URL and added to every request", () => {
  globalThis.location = {
    protocol: "https:",
    host: "phone:8080",
    pathname: "/",
    search: "?view=bare",
    hash: "#token=a%2Bb",
  };
  let shownUrl = null;
  globalThis.history = { replaceState: (_state, _title, url) => (shownUrl = url) };
  assert.equal(socketUrl("/viewer", { session: "" }), "wss://phone:8080/viewer?token=a%2Bb");
  assert.equal(shownUrl, "/?view=bare");
  globalThis.location.hash = "";
  assert.equal(pathWithToken("learn-mouth"), "learn-mouth?token=a%2Bb");
});
