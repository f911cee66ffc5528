// A listening test: one video after another, with two scores each. The server decides what comes
// next, so a reload continues where the judge was.

import { languageFor } from "./language.js";

// The five grades of ITU-T P.910 (absolute category rating), best first.
const GRADES = [
  [5, "Excellent", "优"], [4, "Good", "良"], [3, "Fair", "中"], [2, "Poor", "差"], [1, "Bad", "劣"],
];
const RETRY_MS = 2000;

const element = (name) => document.getElementById(name);
const secrets = new URLSearchParams(location.hash.slice(1)); // a fragment is never sent
const scales = [...document.querySelectorAll("fieldset[data-scale]")];
const address = (path) => `${path}?${secrets}`;
let place = null;

/** Send a request; return the answer, or show the error and throw it. */
async function request(path, body) {
  try {
    const answer = await fetch(address(path), body && { method: "POST", body: JSON.stringify(body) });
    if (!answer.ok) throw Object.assign(new Error((await answer.text()).trim()), { status: answer.status });
    notify("");
    return await answer.json();
  } catch (error) {
    if (error.status === 404) showPart("welcome"); // this study does not know the judge
    notify(`${say({ en: "This did not work. Please try again.", zh: "未能送达，请重试。" })} (${error.message})`);
    throw error;
  }
}

function notify(text) {
  element("notice").hidden = !text;
  element("notice").textContent = text;
}

function showPart(shown) {
  for (const name of ["welcome", "task", "end"]) element(name).hidden = name !== shown;
}

function show(state) {
  element("title").textContent = document.title = state.title;
  element("progress").max = state.videos;
  place = state.place;
  showPart(place === undefined ? "welcome" : place === null ? "end" : "task");
  if (typeof place !== "number") return;
  element("practice").hidden = place >= 0;
  element("progress").value = Math.max(place, 0);
  element("scores").reset();
  setDisabled(true);
  element("send").disabled = true;
  element("play").disabled = false;
  element("video").src = address(`stimulus/${place}`);
  scrollTo(0, 0);
}

function setDisabled(isDisabled) {
  for (const scale of scales) scale.disabled = isDisabled;
}

/** Return the text in the page's language, "en" or "zh". */
function say(texts) {
  return texts[document.documentElement.lang];
}

function chooseLanguage(language) {
  document.documentElement.lang = language;
  element("progress").ariaLabel = say({ en: "rated videos", zh: "已评视频" });
  element("language").textContent = say({ en: "中文", zh: "English" });
}

for (const scale of scales) {
  const name = scale.dataset.scale;
  for (const [value, en, zh] of GRADES) {
    const input = `<input type="radio" name="${name}" value="${value}" id="${name}-${value}">`;
    const texts = `<span class="en">${en}</span><span class="zh">${zh}</span>`;
    scale.insertAdjacentHTML("beforeend", `<label>${input}${texts}</label>`);
  }
}
element("language").addEventListener("click", () => {
  chooseLanguage(document.documentElement.lang === "zh" ? "en" : "zh");
});
element("begin").addEventListener("click", async () => {
  element("begin").disabled = true; // a second click must not add a second judge
  try {
    secrets.set("judge", (await request("judges", {})).judge);
    history.replaceState(null, "", `#${secrets}`);
    show(await request("state"));
  } finally {
    element("begin").disabled = false;
  }
});
element("play").addEventListener("click", async () => {
  element("play").disabled = true;
  try {
    element("video").currentTime = 0;
    await element("video").play();
  } catch (error) {
    element("play").disabled = false;
    notify(`${say({ en: "The video cannot be played.", zh: "无法播放。" })} (${error.message})`);
  }
});
element("video").addEventListener("pause", () => { // a phone pauses it when another app is opened
  element("play").disabled = element("video").ended;
});
element("video").addEventListener("ended", () => setDisabled(false));
element("video").addEventListener("error", () => {
  notify(say({ en: "The video did not load. Please reload the page.", zh: "视频未能加载，请刷新页面。" }));
});
element("scores").addEventListener("change", () => {
  element("send").disabled = scales.some((scale) => !scale.querySelector(":checked"));
});
element("scores").addEventListener("submit", async (event) => {
  event.preventDefault();
  const scores = [...new FormData(event.target)].map(([name, value]) => [name, Number(value)]);
  element("send").disabled = true; // a second click must not send again
  try {
    show(await request("answers", { place, ...Object.fromEntries(scores), language: document.documentElement.lang }));
  } catch {
    element("send").disabled = false;
  }
});
addEventListener("hashchange", () => location.reload()); // another judge's address
chooseLanguage(languageFor(navigator.languages));
await start();

/** Show where the judge is; retry while the server does not answer. */
async function start() {
  try {
    show(await request("state"));
  } catch (error) {
    if (!(error.status < 500)) setTimeout(start, RETRY_MS);
  }
}
