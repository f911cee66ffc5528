// A listening test: one video after another, with two scores each. The server decides what comes
// next, so a reload continues where the judge was.

import { languageFor } from "./language.js";

// The five grades of ITU-T P.910 (absolute category rating), best first.
const GRADES = [[5, "Excellent", "优"], [4, "Good", "良"], [3, "Fair", "中"], [2, "Poor", "差"], [1, "Bad", "劣"]];
const RETRY_MS = 2000;

const element = (name) => document.getElementById(name);
const secrets = new URLSearchParams(location.hash.slice(1)); // a fragment is never sent
const scales = [...document.querySelectorAll("fieldset[data-scale]")];
const address = (path) => `${path}?${secrets}`;
const translate = (en, zh) => (document.documentElement.lang === "zh" ? zh : en);
let place = null;

/** Send a request; return the answer, or show the error and throw it. */
async function request(path, body) {
  try {
    const answer = await fetch(address(path), body && { method: "POST", body: JSON.stringify(body) });
    if (!answer.ok) throw Object.assign(new Error((await answer.text()).trim()), { status: answer.status });
    notify("");
    return await answer.json();
  } catch (error) {
    if (error.status === 404) showPart("welcome"); // the study has no such judge
    notify(`${translate("This did not work. Please try again.", "未能送达，请重试。")} (${error.message})`);
    throw error;
  }
}

function notify(text) {
  element("notice").hidden = !text;
  element("notice").textContent = text;
}

function showPart(shown) {
  for (const name of ["welcome", "task", "end"]) element(name).hidden = name !== shown;
  element("begin").disabled = false;
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
  for (const part of [...scales, element("send")]) part.disabled = true;
  element("play").disabled = false;
  element("video").src = address(`stimulus/${place}`);
  scrollTo(0, 0);
}

function chooseLanguage(language) {
  document.documentElement.lang = language;
  element("progress").ariaLabel = translate("rated videos", "已评视频");
  element("language").textContent = translate("中文", "English");
}

/** Run an action with its button disabled, so that a second click does nothing. */
async function runOnce(button, action) {
  element(button).disabled = true;
  try {
    await action();
  } catch (error) {
    element(button).disabled = false;
    notify(element("notice").textContent || error.message);
  }
}

for (const scale of scales) {
  const name = scale.dataset.scale;
  for (const [value, en, zh] of GRADES) {
    const input = `<input type="radio" name="${name}" value="${value}" id="${name}-${value}">`;
    const texts = `<span class="en">${en}</span><span class="zh">${zh}</span>`;
    scale.insertAdjacentHTML("beforeend", `<label>${input}${texts}</label>`);
  }
}
element("language").addEventListener("click", () => chooseLanguage(translate("zh", "en")));
element("begin").addEventListener("click", () => runOnce("begin", async () => {
  secrets.set("judge", (await request("judges", {})).judge);
  history.replaceState(null, "", `#${secrets}`);
  show(await request("state"));
}));
element("play").addEventListener("click", () => runOnce("play", async () => {
  element("video").currentTime = 0;
  await element("video").play();
}));
element("video").addEventListener("pause", () => { // a phone pauses it when another app is opened
  element("play").disabled = element("video").ended;
});
element("video").addEventListener("ended", () => {
  for (const scale of scales) scale.disabled = false;
});
element("video").addEventListener("error", () => {
  notify(translate("The video did not load. Please reload the page.", "视频未能加载，请刷新页面。"));
});
element("scores").addEventListener("change", () => {
  element("send").disabled = scales.some((scale) => !scale.querySelector(":checked"));
});
element("scores").addEventListener("submit", (event) => {
  event.preventDefault();
  const scores = [...new FormData(event.target)].map(([name, value]) => [name, Number(value)]);
  const answer = { place, ...Object.fromEntries(scores), language: document.documentElement.lang };
  runOnce("send", async () => show(await request("answers", answer)));
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
