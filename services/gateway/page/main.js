// Puts the page together: what arrives, when it is due, and what the buttons do.

import { Head } from "./head.js";
import { LevelMeter, SILENT_DB } from "./level.js";
import { Link } from "./link.js";
import { MouthLesson } from "./learn-mouth.js";
import { NUM_FAPS } from "./messages.js";
import { Microphone } from "./microphone.js";
import { PhoneTrack } from "./phones.js";
import { FapTrack, Playout } from "./playout.js";
import { Presence } from "./presence.js";
import { Recent } from "./recent.js";
import { Sound } from "./sound.js";
import { hint, stateKind, stateText } from "./status.js";
import { VoiceStore } from "./voice.js";

const LABEL_EVERY_MS = 250;
const DELAY_MS = 2000; // over which the delay is measured
const NEWS_MS = 8000; // for which an error, or what happened, stays to be read
const SHOW_PHONES = "kouxing.show-phones"; // where the browser keeps that choice
const OTHER_MODEL =
  "What was learnt of your mouth does not fit this version: press Learn my mouth. 口型模型已更新，请重新学习。";

const element = (id) => document.getElementById(id);
const playout = new Playout();
const track = new FapTrack();
const syllables = new PhoneTrack();
const phones = new PhoneTrack(); // shown instead of the syllables, on request
const meter = new LevelMeter();
const presence = new Presence();
const delays = new Recent(DELAY_MS); // ms, from the own voice to the picture
const sound = new Sound(onSoundState);
const voices = new VoiceStore(storage());
let head = null; // until it is loaded

let connected = false;
let wasConnected = false;
let session = null; // the one we look at
let epoch = 0; // of the session; a greater one is a restart
let wasLive = false; // in this session
let microphoneState = "off";
let missing = []; // services that do not run
let ownSession = null; // the one our microphone feeds
let isSample = false; // the session is the sample sentence, which we asked for
let lips = null; // the lip model that moves the mouth of the session
let chosenLips = null; // the one that was chosen here last, for sessions to come
let numFrames = 0;
const faps = new Float32Array(NUM_FAPS);

/** What the page knows, for whoever embeds or tests it: see proto/GATEWAY.md. */
window.kouxing = {
  set readingS(seconds) {
    lesson.readingS = seconds;
  },
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
      voiceToPictureMs: delays.percentile(0.5),
      sound: sound.state,
      soundSamplesPlayed: sound.numPlayed,
      soundMinusPictureMs: heardMs === null ? null : heardMs - playout.offsetMs,
      microphone: microphoneState === "on",
      lips,
      caption: element("spoken").value,
      voice: voices.voice?.profile ?? "",
      lesson: lesson.step,
    };
  },
};

// --- what arrives --------------------------------------------------------------------------------

function forget() {
  playout.reset();
  track.reset();
  syllables.reset();
  phones.reset();
  meter.reset();
  delays.reset();
}

const link = new Link(new URLSearchParams(location.search).get("session") ?? "", {
  state(isConnected) {
    connected = isConnected;
    wasConnected ||= connected;
    if (!connected) session = null;
    showLips();
    showState();
  },
  fap(mediaTime, values) {
    const nowMs = performance.now();
    const offsetMs = playout.offsetMs;
    if (track.push(mediaTime, values)) playout.frameArrived(nowMs, mediaTime);
    presence.frameArrived(nowMs);
    numFrames++;
    if (playout.offsetMs !== offsetMs) sound.align(nowMs, playout.offsetMs);
  },
  sound(mediaTime, samples) {
    const nowMs = performance.now();
    const offsetMs = playout.offsetMs;
    playout.soundArrived(nowMs, mediaTime, samples.length);
    if (playout.offsetMs !== offsetMs) sound.align(nowMs, playout.offsetMs);
    presence.soundArrived(nowMs);
    sound.push(mediaTime, samples);
    meter.push(mediaTime, samples);
  },
  rest(values) {
    rest = values;
  },
  text(message) {
    switch (message.type) {
      case "session":
        if (message.session === session && session !== null && message.epoch > epoch) {
          showNews("A service crashed and was started again. It goes on.", "hint");
        }
        if (message.session !== session) wasLive = false;
        ({ session, epoch } = message);
        isSample = message.sample;
        // A session that ends is still seen and heard to its end.
        if (session !== null) {
          forget();
          lips = message.lips || null;
        }
        showLips();
        showState();
        break;
      case "lips":
        lips = message.lips;
        showLips();
        break;
      case "status":
        missing = message.missing;
        showState();
        break;
      case "syllable":
        syllables.accept(message);
        break;
      case "phone":
        phones.accept(message);
        break;
      case "error":
        showError(message.text);
        break;
    }
  },
});

// --- every display frame -------------------------------------------------------------------------

const wanted = new Float32Array(NUM_FAPS);
let rest = new Float32Array(NUM_FAPS); // the face while no session moves it
let labelledMs = 0;

function draw(nowMs) {
  requestAnimationFrame(draw);
  playout.outputLatencyMs = sound.outputLatencyMs;
  const heardMs = sound.offsetMs(nowMs);
  if (heardMs !== null) playout.follow(heardMs);
  if (playout.adjust(nowMs)) sound.align(nowMs, playout.offsetMs);

  const mediaTime = playout.mediaAt(nowMs);
  const shownTime = mediaTime === null ? null : track.sample(mediaTime, wanted);
  const hasChanged = mixFace(presence.update(nowMs, shownTime !== null));
  if (hasChanged && lesson.step === "closed") head?.pose(faps); // else the lesson has the machine
  head?.draw(nowMs);
  measureDelay(shownTime);

  showLevel(mediaTime);
  if (mediaTime !== null) showCaption(mediaTime);
  if (nowMs - labelledMs > LABEL_EVERY_MS) {
    labelledMs = nowMs;
    showState();
  }
}

/** Measure how long ago the picture's sound was spoken, where that was here. */
function measureDelay(shownTime) {
  const nowMs = performance.now();
  delays.forget(nowMs);
  if (shownTime === null || session !== ownSession || !presence.isLive(nowMs)) return;
  const ageMs = microphone.ageMs(nowMs, shownTime);
  if (ageMs !== null) delays.add(nowMs, ageMs);
}

/** Set the face to a share of what is wanted, and else to rest; return whether it changed. */
function mixFace(share) {
  let changed = false;
  for (let i = 0; i < NUM_FAPS; i++) {
    const value = Math.fround(rest[i] + share * (wanted[i] - rest[i]));
    changed ||= value !== faps[i];
    faps[i] = value;
  }
  return changed;
}

// --- what is written -----------------------------------------------------------------------------

function showState() {
  const nowMs = performance.now();
  const isLive = connected && presence.isLive(nowMs);
  wasLive ||= isLive;
  const isInterrupted =
    microphoneState === "interrupted" || (wasLive && session !== null && session === ownSession);
  const delayMs = delays.percentile(0.5);
  element("status").dataset.state = stateKind({ connected, isLive });
  const text = stateText({ connected, isLive, isInterrupted, delayMs });
  setText(element("status").lastElementChild, text);
  element("status").title = session === null ? "" : `session ${session}`;
  if (newsTimer === null) {
    const isMicrophoneInterrupted = microphoneState === "interrupted";
    showNotice(hint({ connected, wasConnected, isMicrophoneInterrupted, missing }), "hint");
  }
}

let newsTimer = null;

function showError(text) {
  showNews(text, "error");
}

function showNews(text, kind) {
  clearTimeout(newsTimer);
  newsTimer = setTimeout(() => {
    newsTimer = null;
    showState();
  }, NEWS_MS);
  showNotice(text, kind);
}

function showNotice(text, kind) {
  const notice = element("notice");
  notice.dataset.kind = kind;
  notice.hidden = text === "";
  setText(notice, text);
}

/** Show which lip model it is; only that of our own session can be chosen. */
function showLips() {
  const isOwn = isSample || (session !== null && session === ownSession);
  element("lips").disabled = !isOwn;
  element("lips").setAttribute("aria-pressed", lips === "learnt");
}

function showCaption(mediaTime) {
  const { current, past } = (arePhonesShown() ? phones : syllables).at(mediaTime);
  setText(element("spoken"), current);
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
  // One's own voice is shown as it is recorded, not once more as it comes back.
  if (mediaTime !== null) meter.advance(mediaTime, ownSession === null);
  const db = meter.decibels();
  element("meter").firstElementChild.style.transform = `scaleX(${(1 - db / SILENT_DB).toFixed(3)})`;
  element("meter").setAttribute("aria-valuenow", Math.round(db));
}

/** Return where this browser keeps things; null if it keeps nothing. */
function storage() {
  try {
    return window.localStorage;
  } catch {
    return null;
  }
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

let wasSoundWanted = false; // before the microphone was turned on, or a lesson began

const microphone = new Microphone({
  voice() {
    return voices.voice?.profile ?? "";
  },
  lips() {
    return chosenLips;
  },
  state(state) {
    if (microphoneState === "interrupted" && state === "on") {
      showNews("The microphone is on again.", "hint");
    }
    microphoneState = state;
    element("microphone").setAttribute("aria-pressed", state === "on" || state === "interrupted");
    element("microphone").setAttribute("aria-busy", state === "starting" || state === "interrupted");
    if (state === "off" && ownSession !== null) {
      ownSession = null;
      link.follow("");
      if (wasSoundWanted) sound.turnOn();
    }
  },
  level(value) {
    meter.raise(value);
  },
  session(name) {
    if (ownSession === null) {
      wasSoundWanted = sound.wanted;
      sound.turnOff(); // nobody wants to hear himself late, unless he asks for it
    }
    ownSession = name;
    showLips();
    link.follow(name);
  },
  error({ code, text }) {
    showError(code === "bad-voice" ? OTHER_MODEL : text);
  },
});

element("sample").onclick = () => {
  link.play("sample", chosenLips);
  if (sound.state === "blocked") sound.turnOn();
};

element("lips").onclick = () => {
  chosenLips = lips === "learnt" ? "dynamic-visemes" : "learnt";
  if (isSample) link.chooseLips(chosenLips);
  else microphone.chooseLips(chosenLips);
};

function arePhonesShown() {
  return element("show-phones").getAttribute("aria-pressed") === "true";
}

element("show-phones").setAttribute("aria-pressed", storage()?.getItem(SHOW_PHONES) === "true");
element("show-phones").onclick = () => {
  element("show-phones").setAttribute("aria-pressed", !arePhonesShown());
  storage()?.setItem(SHOW_PHONES, arePhonesShown());
};

element("microphone").onclick = () => {
  if (microphone.active) microphone.stop();
  else microphone.start();
};

const lesson = new MouthLesson(voices, {
  opened() {
    microphone.stop();
    wasSoundWanted = sound.wanted;
    sound.turnOff();
  },
  closed() {
    if (wasSoundWanted) sound.turnOn();
  },
  voice: showVoice,
});

function showVoice() {
  element("learn").setAttribute("aria-pressed", voices.voice !== null);
  if (voices.voice !== null) chosenLips ??= "learnt"; // no others have a voice
}

element("learn").onclick = () => lesson.open();
showVoice();

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
