import assert from "node:assert/strict";
import { readdirSync, readFileSync } from "node:fs";
import test from "node:test";
import { addTexts, languageFor, setLanguage, translate, translateError, translateResponse } from "../../services/gateway/page/language.js";
import { MouthProfileStore, Preferences } from "../../services/gateway/page/storage.js";
import { TEXTS } from "../../services/gateway/page/texts.js";

const PAGE = new URL("../../services/gateway/page/", import.meta.url);

class FakeStorage {
  items = {};
  getItem(key) { return this.items[key] ?? null; }
  setItem(key, value) { this.items[key] = value; }
  removeItem(key) { delete this.items[key]; }
}

test("preferences are stored for the next visit", () => {
  const storage = new FakeStorage();
  const preferences = new Preferences(() => storage);
  assert.equal(preferences.get("lips"), null);
  preferences.set("lips", "ferguson");
  preferences.set("expressiveness", 1.2);
  const later = new Preferences(() => storage);
  assert.deepEqual([later.get("lips"), later.get("expressiveness")], ["ferguson", 1.2]);
  storage.items["kouxing.choices"] = "{";
  assert.equal(new Preferences(() => storage).get("lips"), null);
  const unstored = new Preferences(null);
  unstored.set("head", "man");
  assert.equal(unstored.get("head"), "man");
});

test("the page uses the first language of the browser that it supports", () => {
  assert.equal(languageFor(["fr-FR", "zh-TW", "en"]), "zh");
  assert.equal(languageFor(["en-GB", "zh"]), "en");
  assert.equal(languageFor(["fr"]), "en");
  const page = { documentElement: {}, querySelectorAll: () => [] };
  setLanguage("zh", page);
  assert.equal(page.documentElement.lang, "zh");
  assert.equal(translate("soundDelay", { ms: 160 }), "声音延迟 160 ms");
  setLanguage("en", page);
  assert.equal(translateError({ code: "busy", text: "no" }), "no");
  assert.match(translateError({ code: "bad-mouth-profile", text: "old" }), /mouth profile does not fit/);
  assert.equal(translate("head.new-head"), "new-head", "a name without a text is shown as it is");
  addTexts("lips", { plugged: { en: "Plug-in", zh: "插件" } });
  assert.equal(translate("lips.plugged"), "Plug-in");
});

test("an error of the gateway is JSON or text", async () => {
  const page = { documentElement: {}, querySelectorAll: () => [] };
  const asJson = () => Response.json({ error: "the gateway is stopping" }, { status: 422 });
  assert.equal(await translateResponse(asJson()), "the gateway is stopping");
  assert.equal(await translateResponse(new Response("no token\n", { status: 403 })), "no token");
  setLanguage("zh", page);
  assert.equal(await translateResponse(asJson()), "网关正在停止");
  setLanguage("en", page);
});

test("every text that the page uses exists in both languages, and every text is used", () => {
  const placeholders = (text) => [...text.matchAll(/\{\w+\}/g)].map(String).sort();
  for (const [key, { en, zh }] of Object.entries(TEXTS)) {
    assert.deepEqual(placeholders(en), placeholders(zh), key);
  }
  const files = readdirSync(PAGE).filter((name) => /\.(js|html)$/.test(name) && name !== "texts.js");
  const source = files.map((name) => readFileSync(new URL(name, PAGE), "utf8")).join("\n");
  for (const start of ['\\btranslate\\("', 'data-(?:text|title|label)="']) {
    const keys = [...source.matchAll(new RegExp(`${start}([\\w-]+)"`, "g"))].map(([, key]) => key);
    assert.ok(keys.length > 20, start);
    for (const key of keys) assert.ok(key in TEXTS, key);
  }
  for (const key of Object.keys(TEXTS)) {
    assert.ok(key.includes(".") || source.includes(`"${key}"`), `${key} is not used`);
  }
});

test("a mouth profile is stored until it is deleted", () => {
  const storage = new FakeStorage();
  const learned = { profile: "YWJj", learnedOn: 1, before: {}, after: {} };
  new MouthProfileStore(() => storage).keep(learned);
  const later = new MouthProfileStore(() => storage);
  assert.deepEqual(later.current, learned);
  storage.items["kouxing.voice"] = '{"profile": "YWJj", "learntOn": 1, "before": {}, "after": {}}';
  assert.deepEqual(new MouthProfileStore(() => storage).current, learned);
  later.keep(null);
  assert.deepEqual(storage.items, {});
  assert.equal(later.current, null);
  for (const text of ["{", "1", '{"profile": 5}', '{"profile": ""}']) {
    storage.items["kouxing.voice"] = text;
    assert.equal(new MouthProfileStore(() => storage).current, null, text);
  }
  const unstored = new MouthProfileStore(null);
  unstored.keep(learned);
  assert.equal(unstored.current.profile, "YWJj");
});
