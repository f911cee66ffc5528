// Puts the page together: what arrives, when it is due, and what the buttons do.

import { socketUrl } from "./address.js";
import { Caption } from "./caption.js";
import { Choices } from "./choices.js";
import { element, setText } from "./elements.js";
import { Head } from "./head.js";
import { say } from "./language.js";
import { LevelMeter, SILENT_DB } from "./level.js";
import { Link } from "./link.js";
import { MouthLesson } from "./learn-mouth.js";
import { NUM_FAPS } from "./messages.js";
import { Microphone } from "./microphone.js";
import { Notice } from "./notice.js";
import { FapTrack, Playout } from "./playout.js";
import { Presence } from "./presence.js";
import { Programs } from "./programs.js";
import { Recent } from "./recent.js";
import { Sound } from "./sound.js";
import { Settings } from "./settings.js";
import {
  delayText,
  drawingText,
  errorText,
  hint,
  stateKind,
  stateText,
  turnText,
  waitText,
} from "./status.js";
import { BACKGROUND, VideoRecorder } from "./video.js";
import { MouthProfileStore } from "./mouth-profile.js";

const LABEL_EVERY_MS = 250;
const DELAY_MS = 2000; // over which the delay is measured

const playout = new Playout();
const track = new FapTrack();
const meter = new LevelMeter();
const presence = new Presence();
const programs = new Programs(element("settings"));
const delays = new Recent(DELAY_MS); // ms, from the own voice to the picture
const frameDelays = new Recent(DELAY_MS); // ms, from the own voice to the arrival of its frame
const sound = new Sound(onSoundState);
const mouthProfiles = new MouthProfileStore(storage());
const choices = new Choices(storage());
const caption = new Caption(choices);
const notice = new Notice();
let head = null; // until it is loaded

let connected = false;
let wasConnected = false;
let isRefused = false; // it never connected, though the gateway served this page
let session = null; // the one we look at
let epoch = 0; // of the session; a greater one is a restart
let wasLive = false; // in this session
let microphoneState = "off";
let missing = []; // services that do not run
let ownSession = null; // the one our microphone feeds
let isSample = false; // the session is the sample sentence, which we asked for
let lips = null; // the lip model that moves the mouth of the session
let numFrames = 0;
const faps = new Float32Array(NUM_FAPS);

/** What the page knows, for whoever embeds or tests it: see proto/GATEWAY.md. */
window.kouxing = {
  onPicture: null, // called for each picture that is seen
  set readingS(seconds) {
    lesson.readingS = seconds;
  },
  get state() {
    const nowMs = performance.now();
    const heardMs = sound.offsetMs;
    return {
      connected,
      session,
      missing,
      numFrames,
      faps: Array.from(faps),
      mediaTime: playout.mediaAt(nowMs),
      playoutDelayMs: playout.delayMs,
      frameWaitMs: playout.frameWaitMs,
      voiceToFrameMs: frameDelays.percentile(0.5),
      voiceToPictureMs: delays.percentile(0.5),
      sound: sound.state,
      soundSamplesPlayed: sound.numPlayed,
      soundMinusPictureMs: heardMs === null ? null : heardMs - playout.offsetMs,
      microphone: microphoneState === "on",
      lips,
      caption: caption.text,
      mouthProfile: mouthProfiles.current?.profile ?? "",
      drawing: head?.drawing ?? null,
      recording: video.isRecording,
      lesson: lesson.step,
    };
  },
};

// --- what arrives --------------------------------------------------------------------------------

function forget() {
  playout.reset();
  track.reset();
  caption.reset();
  meter.reset();
  delays.reset();
  frameDelays.reset();
}

const toViewer = (chosen) => socketUrl("/viewer", { session: chosen });
const link = new Link(toViewer, new URLSearchParams(location.search).get("session") ?? "", {
  state(isConnected) {
    connected = isConnected;
    wasConnected ||= connected;
    isRefused = !wasConnected;
    if (!connected) session = null;
    showState();
  },
  fap(mediaTime, values) {
    const nowMs = performance.now();
    if (track.push(mediaTime, values)) playout.frameArrived(nowMs, mediaTime);
    presence.frameArrived(nowMs);
    if (isLiveVoice(nowMs)) addAge(frameDelays, nowMs, mediaTime);
    numFrames++;
  },
  sound(mediaTime, samples) {
    const nowMs = performance.now();
    playout.soundArrived(nowMs, mediaTime, samples.length);
    keepTime(nowMs);
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
          const en = "A service crashed and was started again. It goes on.";
          notice.tell(say({ en, zh: "一个服务崩溃后已重启，会话继续。" }), "hint");
        }
        if (message.session !== session) wasLive = false;
        ({ session, epoch } = message);
        isSample = message.sample;
        // A session that ends is still seen and heard to its end.
        if (session !== null) {
          forget();
          lips = message.lips || null;
        }
        if (isOwn()) chooseExpressiveness();
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
      case "phone":
        caption.accept(message);
        break;
      case "error":
        showError(message);
        break;
    }
  },
});

// --- every display frame -------------------------------------------------------------------------

const wanted = new Float32Array(NUM_FAPS);
let rest = new Float32Array(NUM_FAPS); // the face while no session moves it
let labelledMs = 0;
let shownDb = SILENT_DB; // of the meter

function draw(nowMs) {
  requestAnimationFrame(draw);
  playout.pictureMs = head?.untilSeenMs ?? 0;
  keepTime(nowMs);

  const mediaTime = playout.mediaAt(nowMs + playout.pictureMs); // when the picture is seen
  const shownTime = mediaTime === null ? null : track.sample(mediaTime, wanted);
  const hasChanged = mixFace(presence.update(nowMs, shownTime !== null));
  if (hasChanged && lesson.step === "closed") head?.pose(faps); // else the lesson has the machine
  const shown = { mediaTime: shownTime, faps: faps.slice() };
  head?.draw(nowMs, (seenMs) => pictureSeen(seenMs, shown));

  showLevel(mediaTime);
  if (mediaTime !== null) caption.show(mediaTime);
  if (nowMs - labelledMs > LABEL_EVERY_MS) {
    labelledMs = nowMs;
    showState();
  }
}

/** Keep sound and picture in step; where the page is hidden and nothing drawn, as sound arrives. */
function keepTime(nowMs) {
  playout.isHeard = sound.isPlaying;
  playout.outputLatencyMs = sound.outputLatencyMs;
  playout.adjust(nowMs);
  if (playout.offsetMs !== null) sound.align(nowMs, playout.offsetMs);
}

/** Measure how long ago the sound of a picture was spoken, where that was here. */
function pictureSeen(seenMs, shown) {
  const { mediaTime } = shown;
  if (mediaTime !== null && isLiveVoice(seenMs)) addAge(delays, seenMs, mediaTime);
  window.kouxing.onPicture?.({ seenMs, ...shown });
}

/** Whether what is shown is this browser's voice. */
function isLiveVoice(nowMs) {
  return session === ownSession && presence.isLive(nowMs);
}

function addAge(ages, nowMs, mediaTime) {
  const ageMs = microphone.ageMs(nowMs, mediaTime);
  if (ageMs !== null) ages.add(nowMs, ageMs);
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
  delays.forget(nowMs);
  frameDelays.forget(nowMs);
  const delayMs = delays.percentile(0.5);
  element("status").dataset.state = stateKind({ connected, isLive });
  setText(element("state"), stateText({ connected, isLive, isInterrupted }));
  const isHeard = connected && isLive && sound.state === "on";
  const soundMs = isHeard ? playout.delayMs : null;
  setText(element("delay"), connected && isLive ? delayText(delayMs, soundMs) : "");
  const frameMs = isHeard ? playout.frameWaitMs : null;
  setText(element("wait"), waitText(soundMs, frameMs));
  programs.waitMs = frameMs;
  showDrawing();
  element("status").title = session === null ? "" : `session ${session}`;
  const isMicrophoneInterrupted = microphoneState === "interrupted";
  notice.hint(hint({ connected, wasConnected, isRefused, isMicrophoneInterrupted, missing }));
  element("meter").setAttribute("aria-valuenow", Math.round(shownDb));
}

function showDrawing() {
  if (head === null) return;
  const text = drawingText(head.drawing);
  element("head").title = text;
  setText(element("drawing"), text);
}

function showError(error) {
  notice.tell(errorText(error), "error");
}

/** Whether the session that is shown is our microphone's, or the sample that we asked for. */
function isOwn() {
  return isSample || (session !== null && session === ownSession);
}

function showLips() {
  if (isOwn() && lips !== null) settings.showLips(lips);
}

function showLevel(mediaTime) {
  // One's own voice is shown as it is recorded, not once more as it comes back.
  if (mediaTime !== null) meter.advance(mediaTime, ownSession === null);
  shownDb = meter.decibels();
  const share = (1 - shownDb / SILENT_DB).toFixed(3);
  element("meter").firstElementChild.style.transform = `scaleX(${share})`;
}

/** Return where this browser keeps things; null if it keeps nothing. */
function storage() {
  try {
    return window.localStorage;
  } catch {
    return null;
  }
}

// --- buttons -------------------------------------------------------------------------------------

function onSoundState() {
  const button = element("sound");
  const isBlocked = sound.state === "blocked";
  button.setAttribute("aria-pressed", sound.state === "on");
  button.classList.toggle("asks", isBlocked);
  setText(button.querySelector(".en"), isBlocked ? "Turn on sound" : "Sound");
  setText(button.querySelector(".zh"), isBlocked ? "打开声音" : "声音");
}

element("sound").onclick = () => {
  if (sound.state === "on") sound.turnOff();
  else sound.turnOn();
};

let wasSoundWanted = false; // before the microphone was turned on, or a lesson began

const microphone = new Microphone({
  mouthProfile() {
    return mouthProfiles.current?.profile ?? "";
  },
  lips() {
    return chosenLips();
  },
  state(state) {
    if (microphoneState === "interrupted" && state === "on") {
      notice.tell(say({ en: "The microphone is on again.", zh: "麦克风已恢复。" }), "hint");
    }
    microphoneState = state;
    const isOn = state === "on" || state === "interrupted";
    element("microphone").setAttribute("aria-pressed", isOn && !microphone.isFile);
    element("open-file").setAttribute("aria-pressed", isOn && microphone.isFile);
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
      // Nobody wants to hear himself late, unless he asks for it.
      if (!microphone.isFile) sound.turnOff();
    }
    ownSession = name;
    showLips();
    if (name === session) chooseExpressiveness(); // the viewer heard of it first
    link.follow(name);
  },
  error: showError,
});

element("sample").onclick = () => {
  const chosen = chosenLips();
  link.send(chosen === null ? { play: "sample" } : { play: "sample", lips: chosen });
  if (sound.state === "blocked") sound.turnOn();
};

/** Let the mouth of the session that is shown move as much as was chosen, if anything was. */
function chooseExpressiveness() {
  const expressiveness = choices.get("expressiveness");
  if (expressiveness !== null && session !== null) link.send({ expressiveness });
}

const settings = new Settings(choices, {
  heads: showHead,
  lips(name) {
    if (isSample) link.send({ lips: name });
    else microphone.chooseLips(name);
  },
  expressiveness: chooseExpressiveness,
  express(strengths) {
    link.send({ express: strengths });
  },
});

element("microphone").onclick = () => {
  const stops = microphone.active && !microphone.isFile;
  microphone.stop();
  if (!stops) microphone.start();
};

element("open-file").onclick = () => {
  if (microphone.isFile) microphone.stop();
  else element("file").click();
};
element("file").onchange = ({ target }) => {
  if (target.files.length > 0) speakFile(target.files[0]);
  target.value = ""; // the same file again is a choice, too
};
document.ondragover = (event) => event.preventDefault();
document.ondrop = (event) => {
  event.preventDefault();
  if (event.dataTransfer.files.length > 0) speakFile(event.dataTransfer.files[0]);
};

function speakFile(file) {
  if (sound.state === "blocked") sound.turnOn();
  microphone.speak(file);
}

const video = new VideoRecorder();

element("record").onclick = async () => {
  if (video.isRecording) {
    video.stop();
    sound.untap();
    head.film(null);
  } else if (head !== null) {
    head.film(BACKGROUND);
    video.start(element("head"), await sound.tap());
  }
  element("record").setAttribute("aria-pressed", video.isRecording);
};

const lesson = new MouthLesson(mouthProfiles, {
  opened() {
    microphone.stop();
    wasSoundWanted = sound.wanted;
    sound.turnOff();
  },
  closed() {
    if (wasSoundWanted) sound.turnOn();
  },
  profileChanged: showMouthProfile,
});

/** Return the lip model for sessions to come; null for the system's. Other models take no mouth profile. */
function chosenLips() {
  return choices.get("lips") ?? (mouthProfiles.current === null ? null : "learnt");
}

function showMouthProfile() {
  element("learn").setAttribute("aria-pressed", mouthProfiles.current !== null);
}

element("learn").onclick = () => lesson.open();

const TURNS = {
  ArrowLeft: [10, 0],
  ArrowRight: [-10, 0],
  ArrowUp: [0, 10],
  ArrowDown: [0, -10],
  Home: [], // to the front
};

element("head").onkeydown = (event) => {
  if (head === null || TURNS[event.key] === undefined) return;
  event.preventDefault();
  setText(element("turned"), turnText(head.turn(...TURNS[event.key])));
};
showMouthProfile();

// --- begin ---------------------------------------------------------------------------------------

let headLoaded = Promise.resolve(); // when the head that was chosen last is there

/** Show a head by its name; "" for the one that the gateway was started with. */
function showHead(name) {
  headLoaded = headLoaded.then(() => loadHead(name)); // one after another: the last one stays
  return headLoaded;
}

async function loadHead(name) {
  element("loading").hidden = false;
  setText(element("no-head"), "");
  const file = name === "" ? "head.glb" : `head-${name}.glb`;
  try {
    const loading = head ?? makeHead();
    await loading.load(file);
    head = loading;
    head.pose(faps);
    head.draw(performance.now(), () => {}); // the first time takes long: nothing is measured
    playout.reset();
  } catch (error) {
    const { message } = error;
    const text = say({
      en: error.en ?? `No head (is there a ${file}? see kouxing head export): ${message}`,
      zh: error.zh ?? `没有头像（缺少 ${file}？见 kouxing head export）：${message}`,
    });
    showError({ text });
    setText(element("no-head"), text); // for as long as there is none
  }
  element("loading").hidden = true;
}

function makeHead() {
  try {
    return new Head(element("head"), document.querySelector("footer"));
  } catch {
    throw {
      en: "This browser draws nothing in 3-D (WebGL): turn on hardware acceleration in its settings, or try another browser.",
      zh: "浏览器无法绘制 3-D 图像（WebGL）：请在浏览器设置中打开硬件加速，或换一个浏览器。",
    };
  }
}

const view = new URLSearchParams(location.search);
document.body.dataset.view = view.get("view") ?? "";
if (view.has("background")) document.documentElement.style.background = view.get("background");
requestAnimationFrame(draw);
sound.turnOn();
await showHead(element("heads").value);
