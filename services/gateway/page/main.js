// Connects the parts of the page.

import { isTokenWrong, socketUrl } from "./address.js";
import { Caption } from "./caption.js";
import { element } from "./elements.js";
import { GatewayState } from "./gateway-state.js";
import { setLanguage, translate, translateError } from "./language.js";
import { LearnMouthDialog } from "./learn-mouth.js";
import { LevelMeter, showLevel } from "./level.js";
import { Notice } from "./notice.js";
import { loadOffers } from "./offers.js";
import { Player } from "./player.js";
import { SendersPanel } from "./senders-panel.js";
import { FACE_SETTINGS, Settings, preferredLanguage } from "./settings.js";
import { Sound } from "./sound.js";
import { SpeechControls } from "./speech-controls.js";
import { Stage } from "./stage.js";
import { StatusBar } from "./status-bar.js";
import { MouthProfileStore, Preferences } from "./storage.js";
import { ViewerSocket } from "./viewer-socket.js";

const STATUS_INTERVAL_MS = 250;

const query = new URLSearchParams(location.search);
const requestedSession = query.get("session") ?? ""; // "": the newest
const preferences = new Preferences(() => localStorage);
const mouthProfiles = new MouthProfileStore(() => localStorage);
const notice = new Notice();
const offers = await loadOffers(() => {
  setLanguage(preferredLanguage(preferences));
  notice.showHint(translate("gatewayLost"));
});
const meter = new LevelMeter();
const gateway = new GatewayState();
const settings = new Settings(preferences, offers, {
  heads: (name) => stage.load(name),
  speechLanguage: () => speech.restart(),
  lipModel: (name) => (gateway.isSample ? socket.send({ lip_model: name }) : speech.microphone.chooseLipModel(name)),
  faceSettings: sendFaceSettings,
  expressions: (strengths) => socket.send({ expressions: strengths }),
});
const caption = new Caption(preferences);
const sound = new Sound(() => speech.showSound());
const speech = new SpeechControls(sound, {
  mouthProfile: () => mouthProfiles.current?.profile ?? "",
  language: () => element("speech-language").value,
  lipModel: chosenLipModel,
  level: (value) => meter.raise(value),
  error: showError,
  fileStarted: () => notice.clear(), // an error about the file before it
  fileEnded(file) {
    const isShown = gateway.session !== null && gateway.session === speech.session;
    if (isShown && !caption.hasSpeech) showToast(translate("noSpeech", { file }));
  },
  toast: showToast,
  session(name) {
    if (name !== null) {
      showLipModel();
      if (name === gateway.session) sendFaceSettings(); // its "session" message arrived first
    }
    socket.follow(name ?? requestedSession);
  },
});
const player = new Player(sound, (nowMs, mediaTime) =>
  gateway.session === speech.session ? speech.microphone.ageMs(nowMs, mediaTime) : null,
);
const stage = new Stage(player.faps, sound, {
  loaded: () => player.playout.reset(),
  failed: (text) => showError({ text }),
  toast: showToast,
});
const senders = new SendersPanel(element("settings"));
const statusBar = new StatusBar({ gateway, player, speech, sound, notice, senders });
const learnMouth = new LearnMouthDialog(mouthProfiles, {
  opened: () => speech.pause(),
  closed: () => {
    speech.resume();
    cancelAnimationFrame(nextDraw);
    nextDraw = requestAnimationFrame(draw);
  },
  profileChanged: showMouthProfile,
});
const socket = new ViewerSocket(
  (session) => socketUrl("/viewer", { session }),
  requestedSession,
  {
    async state(isConnected) {
      gateway.setConnected(isConnected);
      statusBar.show();
      if (!isConnected && gateway.wasConnected) {
        const isWrong = await isTokenWrong();
        if (!gateway.isConnected) gateway.isRejected = isWrong;
      }
    },
    fap: (mediaTime, values) => player.addFrame(mediaTime, values),
    sound(mediaTime, samples) {
      player.addSound(mediaTime, samples);
      meter.push(mediaTime, samples);
    },
    rest: (values) => (player.restFaps = values),
    text: handleMessage,
  },
);

function handleMessage(message) {
  const handle = {
    session: showSession,
    syllable: () => caption.add(message),
    phone: () => caption.add(message),
    error: showError,
    face() {
      gateway.lipModel = message.lip_model || null;
      settings.showSizes(message);
      showLipModel();
    },
    acoustic() {
      gateway.acoustic = message.acoustic;
      statusBar.show();
    },
    status() {
      gateway.missing = message.missing;
      statusBar.show();
    },
  }[message.type];
  handle?.(message);
}

function showSession(message) {
  const { isOther, isRestart } = gateway.setSession(message);
  if (isRestart) showToast(translate("serviceRestarted"));
  if (isOther) statusBar.reset();
  if (gateway.session !== null) {
    // A session that has ended stays visible and audible to its end.
    player.reset(isOther);
    caption.reset(message.language);
    settings.showSizes(message);
    meter.reset();
  }
  if (isOwnSession()) sendFaceSettings();
  showLipModel();
  statusBar.show();
}

function showToast(text) {
  notice.showToast(text, "hint");
}

function showError(error) {
  notice.showToast(translateError(error), "error");
}

/** Whether the session that is shown is the microphone's, or the sample that this page asked for. */
function isOwnSession() {
  return gateway.isSample || (gateway.session !== null && gateway.session === speech.session);
}

/** Return the lip model for new sessions, or null for the default. Only "learned" uses a profile. */
function chosenLipModel() {
  const chosen = preferences.get("lips");
  if (chosen in offers.lips) return chosen; // a stored name may no longer exist
  return mouthProfiles.current === null ? null : "learned";
}

function showLipModel() {
  if (isOwnSession() && gateway.lipModel !== null) settings.showLipModel(gateway.lipModel);
}

function chooseAcousticModel(acoustic) {
  socket.send({ acoustic });
  element("full-model").hidden = acoustic === "full";
}

function sendFaceSettings() {
  const chosen = FACE_SETTINGS.filter((id) => preferences.get(id) !== null);
  if (!chosen.length || gateway.session === null) return;
  socket.send(Object.fromEntries(chosen.map((id) => [id, preferences.get(id)])));
}

function showMouthProfile() {
  element("learn").setAttribute("aria-pressed", mouthProfiles.current !== null);
}

let statusMs = 0; // when the status was shown last

let nextDraw = 0; // id of the requested call

function draw(nowMs) {
  // While the user's mouth is being learned, the machine is needed to find their face.
  if (learnMouth.step !== "closed") return;
  nextDraw = requestAnimationFrame(draw);
  const { mediaTime, frameTime, hasChanged } = player.update(nowMs, stage.visibleDelayMs);
  const shown = { mediaTime: frameTime, faps: player.faps.slice() };
  stage.draw(nowMs, hasChanged, (seenMs) => {
    player.imageVisible(nowMs, seenMs, frameTime);
    window.kouxing.onImage?.({ seenMs, ...shown });
  });
  if (mediaTime !== null) {
    // The user's own voice is shown when it is recorded, not again when it is played.
    meter.advance(mediaTime, speech.session === null);
    caption.show(mediaTime);
  }
  showLevel(meter.nextDecibels());
  if (nowMs - statusMs > STATUS_INTERVAL_MS) {
    statusMs = nowMs;
    statusBar.show();
    stage.showDrawing();
  }
}

/** State for programs that embed or test the page; see proto/GATEWAY.md. */
window.kouxing = {
  onImage: null, // called for each image that becomes visible
  set readingS(seconds) {
    learnMouth.readingS = seconds;
  },
  get state() {
    return {
      connected: gateway.isConnected,
      session: gateway.session,
      missing: gateway.missing,
      numFrames: player.numFrames,
      faps: Array.from(player.faps),
      mediaTime: player.playout.mediaAt(performance.now()),
      lateMs: player.lateness.recentMs,
      playoutDelayMs: player.playout.delayMs,
      frameWaitMs: player.playout.frameWaitMs,
      voiceToFrameMs: player.voiceToFrameMs,
      voiceToImageMs: player.voiceToImageMs,
      sound: sound.state,
      soundSamplesPlayed: sound.numPlayed,
      soundMinusImageMs: player.soundMinusImageMs,
      microphone: speech.state === "on",
      lipModel: gateway.lipModel,
      acoustic: gateway.acoustic,
      caption: caption.text,
      mouthProfile: mouthProfiles.current?.profile ?? "",
      drawing: stage.drawing,
      recording: stage.isRecording,
      lesson: learnMouth.step,
    };
  },
};

element("sample").onclick = () => {
  const name = chosenLipModel();
  socket.send(name === null ? { play: "sample" } : { play: "sample", lip_model: name });
  speech.unblockSound();
};
element("learn").onclick = () => learnMouth.open();
element("light-model").onclick = () => chooseAcousticModel("light");
element("full-model").onclick = () => chooseAcousticModel("full");
document.body.dataset.view = query.get("view") ?? "";
if (query.has("background")) document.documentElement.style.background = query.get("background");
showMouthProfile();
requestAnimationFrame(draw);
speech.turnSoundOn();
await stage.load(element("heads").value);
