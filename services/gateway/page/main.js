// Puts the page together: what arrives, when it is due, and what the buttons do.

import { Head } from "./head.js";
import { Link, NUM_FAPS } from "./link.js";
import { Microphone } from "./microphone.js";
import { FapTrack, Playout } from "./playout.js";
import { Sound } from "./sound.js";

const STALL_MS = 500; // without frames the face goes to rest
const REST_MS = 80; // time constant of going there and coming back
const NUM_PAST = 8; // phones shown beside the current one
const MAX_PHONES = 100;
const MAX_LOUDNESS = 500; // chunks
const STALE = 8 * 16000; // samples after which the last phone is no longer shown
const SILENCE = "sil";
const LABEL_EVERY_MS = 250;
const ERROR_MS = 8000; // for which an error stays to be read

const element = (id) => document.getElementById(id);
const playout = new Playout();
const track = new FapTrack();
const sound = new Sound(onSoundState);
let head = null; // until it is loaded

let connected = false;
let session = null; // the one we look at
let missing = []; // services that do not run
let ownSession = null; // the one our microphone feeds
let phones = []; // { index, unit, mediaTime }, by index
let arrivedMs = -Infinity; // when the newest frame came
let numFrames = 0;
let presence = 0; // 1: the face is the stream's, 0: at rest
let loudness = []; // { mediaTime, level } of the sound that is still to be heard
let level = 0; // as the meter shows it
const faps = new Float32Array(NUM_FAPS);

/** What the page knows, for whoever embeds or tests it: see proto/GATEWAY.md. */
window.kouxing = {
  get state() {
    const nowMs = performance.now();
    const heardMs = sound.offsetMs(nowMs);
    return {
      connected,
      session,
      missing,
      numFrames,
      faps: Array.from(faps),
      mediaTime: playout.mediaAt(nowMs),
      playoutDelayMs: playout.delayMs,
      sound: sound.state,
      soundSamplesPlayed: sound.numPlayed,
      soundMinusPictureMs: heardMs === null ? null : heardMs - playout.offsetMs,
      microphone: element("microphone").getAttribute("aria-pressed") === "true",
      phone: element("phone").value,
    };
  },
};

// --- what arrives --------------------------------------------------------------------------------

function forget() {
  playout.reset();
  track.reset();
  phones = [];
  loudness = [];
}

const link = new Link(new URLSearchParams(location.search).get("session") ?? "", {
  state(isConnected) {
    connected = isConnected;
    if (!connected) session = null;
    showState();
  },
  fap(mediaTime, values) {
    const nowMs = performance.now();
    const offsetMs = playout.offsetMs;
    if (track.push(mediaTime, values)) playout.frameArrived(nowMs, mediaTime);
    arrivedMs = nowMs;
    numFrames++;
    if (playout.offsetMs !== offsetMs) sound.align(nowMs, playout.offsetMs);
  },
  sound(mediaTime, samples) {
    const nowMs = performance.now();
    const offsetMs = playout.offsetMs;
    playout.soundArrived(nowMs, mediaTime, samples.length);
    if (playout.offsetMs !== offsetMs) sound.align(nowMs, playout.offsetMs);
    sound.push(mediaTime, samples);
    loudness.push({ mediaTime, level: rms(samples) });
    if (loudness.length > MAX_LOUDNESS) loudness.shift();
  },
  text(message) {
    switch (message.type) {
      case "session":
        session = message.session;
        // A session that ends is still seen and heard to its end.
        if (session !== null) forget();
        showState();
        break;
      case "status":
        missing = message.missing;
        showState();
        break;
      case "phone":
        hear(message);
        break;
      case "error":
        showError(message.text);
        break;
    }
  },
});

function hear({ index, unit, media_time: mediaTime, duration }) {
  const phone = { index, unit, mediaTime, end: mediaTime + duration };
  const known = phones.findIndex((other) => other.index === index);
  if (known >= 0) phones[known] = phone;
  else phones.push(phone);
  if (phones.length > MAX_PHONES) phones.shift();
}

function rms(samples) {
  let squares = 0;
  for (const sample of samples) squares += sample * sample;
  return Math.sqrt(squares / samples.length) / 32768;
}

// --- every display frame -------------------------------------------------------------------------

const wanted = new Float32Array(NUM_FAPS);
let drawnMs = performance.now();
let labelledMs = 0;

function draw(nowMs) {
  requestAnimationFrame(draw);
  const elapsedMs = nowMs - drawnMs;
  drawnMs = nowMs;
  // While this page was busy nothing could arrive, which is no stall of the stream.
  if (elapsedMs > STALL_MS / 2) arrivedMs = Math.min(nowMs, arrivedMs + elapsedMs);
  playout.displayFrameMs = Math.min(100, head?.frameMs ?? playout.displayFrameMs);
  playout.outputLatencyMs = sound.outputLatencyMs;
  const heardMs = sound.offsetMs(nowMs);
  if (heardMs !== null) playout.follow(heardMs);
  if (playout.adjust(nowMs)) sound.align(nowMs, playout.offsetMs);

  const mediaTime = playout.mediaAt(nowMs);
  const isThere = mediaTime !== null && track.sample(mediaTime, wanted);
  const isLive = isThere && nowMs - arrivedMs < STALL_MS;
  presence += ((isLive ? 1 : 0) - presence) * (1 - Math.exp(-elapsedMs / REST_MS));
  if (Math.abs(presence - isLive) < 0.001) presence = isLive ? 1 : 0;
  if (settle()) head?.pose(faps);
  head?.draw(nowMs);

  showLevel(mediaTime);
  if (mediaTime !== null) showPhones(mediaTime);
  if (nowMs - labelledMs > LABEL_EVERY_MS) {
    labelledMs = nowMs;
    showState();
  }
}

/** Bring the face to what is wanted; return whether it changed. */
function settle() {
  let changed = false;
  for (let i = 0; i < NUM_FAPS; i++) {
    const value = Math.fround(presence * wanted[i]);
    changed ||= value !== faps[i];
    faps[i] = value;
  }
  return changed;
}

// --- what is written -----------------------------------------------------------------------------

function showState() {
  const nowMs = performance.now();
  const isLive = connected && nowMs - arrivedMs < STALL_MS;
  element("status").dataset.state = !connected ? "lost" : isLive ? "live" : "waiting";
  let text = "live 直播";
  if (!connected) text = "connecting … 连接中";
  else if (session === null) text = "waiting for speech 等待语音";
  else if (!isLive) text = "paused 暂停";
  if (isLive && session !== null) {
    const ageMs = microphone.ageMs(nowMs, playout.mediaAt(nowMs));
    const delayMs = ageMs ?? playout.delayMs;
    if (delayMs !== null) text += ` · ${Math.round(delayMs / 5) * 5} ms`;
  }
  setText(element("status").lastElementChild, text);
  element("status").title = session === null ? "" : `session ${session}`;
  if (errorTimer === null) {
    const isControl = missing[0] === "control";
    const start = isControl ? "kouxing run" : missing.map((name) => `kouxing ${name}`).join("; ");
    const hint = `no ${missing.join(", no ")} is running; start: ${start}`;
    showNotice(connected && missing.length > 0 ? hint : "", "hint");
  }
}

let errorTimer = null;

function showError(text) {
  clearTimeout(errorTimer);
  errorTimer = setTimeout(() => {
    errorTimer = null;
    showState();
  }, ERROR_MS);
  showNotice(text, "error");
}

function showNotice(text, kind) {
  const notice = element("notice");
  notice.dataset.kind = kind;
  notice.hidden = text === "";
  setText(notice, text);
}

function showPhones(mediaTime) {
  let current = phones.length - 1;
  while (current >= 0 && phones[current].mediaTime > mediaTime) current--;
  const phone = phones[current];
  const isOver = phone === undefined || phone.unit === SILENCE || mediaTime > phone.end + STALE;
  setText(element("phone"), isOver ? "" : phone.unit);
  const past = phones
    .slice(Math.max(0, current - NUM_PAST), isOver ? current + 1 : Math.max(0, current))
    .map(({ unit }) => (unit === SILENCE ? "·" : unit));
  const key = past.join(" ");
  if (element("past").dataset.key !== key) {
    element("past").dataset.key = key;
    element("past").replaceChildren(...past.map(listItem));
  }
}

function listItem(text) {
  const item = document.createElement("li");
  item.textContent = text;
  return item;
}

function showLevel(mediaTime) {
  while (mediaTime !== null && loudness[0]?.mediaTime <= mediaTime) {
    const heard = loudness.shift();
    if (ownSession === null) level = Math.max(level, heard.level);
  }
  const db = Math.max(-60, 20 * Math.log10(level + 1e-6));
  element("meter").firstElementChild.style.transform = `scaleX(${(1 + db / 60).toFixed(3)})`;
  element("meter").setAttribute("aria-valuenow", Math.round(db));
  level *= 0.9;
}

function setText(target, text) {
  if (target.textContent !== text) target.textContent = text;
}

// --- buttons -------------------------------------------------------------------------------------

function onSoundState() {
  const button = element("sound");
  const isBlocked = sound.state === "blocked";
  if (playout.offsetMs !== null) sound.align(performance.now(), playout.offsetMs);
  button.setAttribute("aria-pressed", sound.state === "on");
  button.classList.toggle("asks", isBlocked);
  setText(button.querySelector("span").firstChild, isBlocked ? "Turn on sound " : "Sound ");
}

element("sound").onclick = () => {
  if (sound.state === "on") sound.turnOff();
  else sound.turnOn();
};

let wasSoundWanted = false; // before the microphone was turned on

const microphone = new Microphone({
  state(state) {
    element("microphone").setAttribute("aria-pressed", state === "on");
    element("microphone").setAttribute("aria-busy", state === "starting");
    if (state === "off" && ownSession !== null) {
      ownSession = null;
      link.follow("");
      if (wasSoundWanted) sound.turnOn();
    }
  },
  level(value) {
    level = Math.max(level, value);
  },
  session(name) {
    ownSession = name;
    wasSoundWanted = sound.wanted;
    sound.turnOff(); // nobody wants to hear himself late, unless he asks for it
    link.follow(name);
  },
  error(message) {
    showError(message.text);
  },
});

element("sample").onclick = () => {
  link.play("sample");
  if (sound.state === "blocked") sound.turnOn();
};

element("microphone").onclick = () => {
  if (microphone.active) microphone.stop();
  else microphone.start();
};

// --- begin ---------------------------------------------------------------------------------------

requestAnimationFrame(draw);
sound.turnOn();
try {
  head = await Head.load(element("head"), document.querySelector("footer"), "head.glb");
  head.pose(faps);
  head.draw(performance.now()); // the first time takes long, which says nothing about the stream
  playout.reset();
} catch (error) {
  showError(`no head (is there a head.glb? see 'kouxing head export'): ${error.message}`);
}
element("loading").hidden = true;
