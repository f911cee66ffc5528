// The listening test: sound check, then video after video with two scores each. What comes next is
// the server's to say, so that a reload goes on where it was.

import { languageFor, say, setLanguage } from "./language.js";

// The five grades of ITU-T P.910 (absolute category rating), best first.
const GRADES = [
  [5, { en: "Excellent", zh: "优" }],
  [4, { en: "Good", zh: "良" }],
  [3, { en: "Fair", zh: "中" }],
  [2, { en: "Poor", zh: "差" }],
  [1, { en: "Bad", zh: "劣" }],
];
const NUM_BEEPS = [2, 3, 4, 5, 6];
const PARTS = ["welcome", "check", "task", "end"];
const RETRY_MS = 2000;

const element = (name) => document.getElementById(name);
const secrets = new URLSearchParams(location.hash.slice(1)); // never sent with the page's address
const scales = [...document.querySelectorAll("fieldset[data-scale]")];
let place = null;

/** Ask the server; return what it answers, or show why not and throw. */
async function ask(path, body) {
  try {
    const answer = await fetch(address(path), body && { method: "POST", body: JSON.stringify(body) });
    if (!answer.ok) throw Object.assign(new Error((await answer.text()).trim()), { status: answer.status });
    notify("");
    return await answer.json();
  } catch (error) {
    if (error.status === 404) { // who scored nothing is forgotten after a day
      showPart("welcome");
      notify(say({ en: "This address is not known here; please begin anew.", zh: "本页地址无效，请重新开始。" }));
    } else {
      notify(`${say({ en: "This did not arrive; please try again.", zh: "未能送达，请重试。" })} (${error.message})`);
    }
    throw error;
  }
}

function address(path) {
  return `${path}?${secrets}`;
}

function notify(text) {
  element("notice").hidden = !text;
  element("notice").textContent = text;
}

/** Show what the server says comes next. */
function show(state) {
  const part = !state.hears ? "check" : state.place === null ? "end" : "task";
  showPart(part);
  if (part === "check") loadBeeps();
  if (part === "task") loadVideo(state.place);
}

function showPart(shown) {
  for (const name of PARTS) element(name).hidden = name !== shown;
}

function loadBeeps() {
  element("beeps").disabled = true;
  for (const input of element("beeps").querySelectorAll("input")) input.checked = false;
  element("sound").src = address("beeps");
}

function loadVideo(next) {
  place = next;
  element("practice").hidden = place >= 0;
  element("progress").value = Math.max(place, 0);
  element("scores").reset();
  for (const scale of scales) scale.disabled = true;
  element("send").disabled = true;
  element("play").disabled = true;
  element("video").src = address(`stimulus/${place}`);
  element("video").load();
  element("play").disabled = false;
  scrollTo(0, 0);
}

function addChoices(fieldset, name, choices) {
  for (const [value, text] of choices) {
    const input = Object.assign(document.createElement("input"), { type: "radio", name, value, id: `${name}-${value}` });
    const label = document.createElement("label");
    label.append(input);
    for (const language of ["en", "zh"]) {
      const span = Object.assign(document.createElement("span"), { className: language });
      span.textContent = text[language];
      label.append(span);
    }
    fieldset.querySelector(".scale").append(label);
  }
}

function speak(language) {
  setLanguage(language);
  element("language").textContent = say({ en: "中文", zh: "English" });
}

function play(media, button) {
  button.disabled = true;
  if (media.currentTime) media.currentTime = 0; // what was interrupted begins anew
  media.play().catch((error) => {
    button.disabled = false;
    notify(`${say({ en: "This cannot be played.", zh: "无法播放。" })} (${error.message})`);
  });
}

addChoices(element("beeps"), "heard", NUM_BEEPS.map((number) => [number, { en: number, zh: number }]));
for (const scale of scales) addChoices(scale, scale.dataset.scale, GRADES);

element("language").addEventListener("click", () => {
  speak(document.documentElement.lang === "zh" ? "en" : "zh");
});
element("begin").addEventListener("click", async () => {
  element("begin").disabled = true; // a second click is no second judge
  try {
    const { judge } = await ask("judges", {});
    secrets.set("judge", judge);
    history.replaceState(null, "", `#${secrets}`);
    show(await ask("state"));
  } finally {
    element("begin").disabled = false;
  }
});
for (const [media, button] of [["sound", "play-beeps"], ["video", "play"]]) {
  element(button).addEventListener("click", () => play(element(media), element(button)));
  element(media).addEventListener("pause", () => { // a phone stops it when another app is opened
    element(button).disabled = element(media).ended;
  });
}
element("sound").addEventListener("ended", () => {
  element("play-beeps").disabled = false;
  element("beeps").disabled = false;
});
element("beeps").addEventListener("change", async (event) => {
  const state = await ask("beeps", { beeps: Number(event.target.value) });
  show(state);
  if (!state.hears) {
    notify(say({ en: "That was another number; please listen again.", zh: "数目不对，请再听一次。" }));
  }
});
element("video").addEventListener("ended", () => {
  for (const scale of scales) scale.disabled = false;
});
element("video").addEventListener("error", () => {
  notify(say({ en: "The video did not arrive; please reload the page.", zh: "视频未能加载，请刷新页面。" }));
});
element("scores").addEventListener("change", () => {
  element("send").disabled = scales.some((scale) => !scale.querySelector(":checked"));
});
element("scores").addEventListener("submit", async (event) => {
  event.preventDefault();
  const scores = [...new FormData(event.target)].map(([name, value]) => [name, Number(value)]);
  element("send").disabled = true; // a second click sends nothing
  try {
    const language = document.documentElement.lang;
    show(await ask("answers", { place, ...Object.fromEntries(scores), language }));
  } catch {
    element("send").disabled = false;
  }
});

addEventListener("hashchange", () => location.reload()); // another judge's address
speak(languageFor(navigator.languages));
await start();

/** Show where the judge is; again and again, if the server does not answer. */
async function start() {
  try {
    const study = await ask("study");
    element("title").textContent = study.title;
    document.title = study.title;
    element("progress").max = study.videos;
    element("language").hidden = study.languages.length < 2;
    if (!study.languages.includes(document.documentElement.lang)) speak(study.languages[0]);
    if (secrets.has("judge")) show(await ask("state"));
    else showPart("welcome");
  } catch (error) {
    if (!(error.status < 500)) setTimeout(start, RETRY_MS);
  }
}
