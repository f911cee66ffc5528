import assert from "node:assert/strict";
import test from "node:test";
import { Choices } from "../choices.js";
import { languageFor, say, setLanguage } from "../language.js";
import { errorText } from "../status.js";

class FakeStorage {
  items = {};
  getItem(key) { return this.items[key] ?? null; }
  setItem(key, value) { this.items[key] = value; }
}

test("choices stay for the next visit", () => {
  const storage = new FakeStorage();
  const choices = new Choices(storage);
  assert.equal(choices.get("lips"), null);
  choices.set("lips", "ferguson");
  choices.set("expressiveness", 1.2);
  const later = new Choices(storage);
  assert.deepEqual([later.get("lips"), later.get("expressiveness")], ["ferguson", 1.2]);
});

test("choices stay until the page is closed where nothing may be stored", () => {
  const choices = new Choices(null);
  choices.set("head", "man");
  assert.equal(choices.get("head"), "man");
});

test("what was not written here is no choice", () => {
  for (const text of ["{", "null", "7"]) {
    const storage = new FakeStorage();
    storage.items["kouxing.choices"] = text;
    assert.equal(new Choices(storage).get("lips"), null, text);
  }
});

test("the first language of the browser that the page has is spoken", () => {
  assert.equal(languageFor(["fr-FR", "zh-TW", "en"]), "zh");
  assert.equal(languageFor(["en-GB", "zh"]), "en");
  assert.equal(languageFor(["fr"]), "en");
});

test("texts and errors come in the language that was set", () => {
  const page = { documentElement: {}, querySelectorAll: () => [] };
  const error = { code: "timeout", text: "no answer" };
  setLanguage("zh", page);
  assert.equal(page.documentElement.lang, "zh");
  assert.equal(say({ en: "a", zh: "啊" }), "啊");
  assert.match(errorText(error), /请重试（no answer）/);
  assert.equal(errorText({ code: "refused", text: "no" }), "no");
  setLanguage("en", page);
  assert.equal(say({ en: "a", zh: "啊" }), "a");
  assert.equal(errorText(error), "no answer");
});
