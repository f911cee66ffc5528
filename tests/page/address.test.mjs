import assert from "node:assert/strict";
import test from "node:test";
import { isTokenWrong, pathWithToken, socketUrl } from "../../services/gateway/page/address.js";

const stored = {};
globalThis.sessionStorage = {
  getItem: (key) => stored[key] ?? null,
  setItem: (key, value) => (stored[key] = value),
};

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

/** Return the path of a page that is loaded again with a hash. */
async function pathAfterReload(hash) {
  globalThis.location = { pathname: "/", search: "", hash };
  const page = await import(`../../services/gateway/page/address.js?${Math.random()}`);
  return page.pathWithToken("sound");
}

test("the token lasts until the tab closes, and a new address replaces it", async () => {
  assert.equal(await pathAfterReload(""), "sound?token=a%2Bb");
  assert.equal(await pathAfterReload("#token=new"), "sound?token=new");
  assert.equal(await pathAfterReload(""), "sound?token=new");
  globalThis.sessionStorage = null; // as if the browser forbids it
  assert.equal(await pathAfterReload("#token=c"), "sound?token=c");
  assert.equal(await pathAfterReload(""), "sound");
});

test("a wrong token is distinguished from a gateway that does not answer", async () => {
  globalThis.fetch = async (path) => ({ status: path === "/viewer?token=a%2Bb" ? 403 : 404 });
  assert.equal(await isTokenWrong(), true);
  globalThis.fetch = async () => ({ status: 400 }); // not a WebSocket
  assert.equal(await isTokenWrong(), false);
  globalThis.fetch = async () => {
    throw new TypeError("Failed to fetch");
  };
  assert.equal(await isTokenWrong(), false);
});
