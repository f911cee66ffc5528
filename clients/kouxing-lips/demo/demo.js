// The demo page: heads and avatars that speak with the microphone, a sample or a file.

import "kouxing-client/face.js";

const HEADS = ["woman", "man", "ada", "leo", "mika", "rosa", "child", "elder"];
const NUM_PHONES = 12; // number of phones on the page
const AVATAR = /\.(vrm|glb)$/i;
const byId = (id) => document.getElementById(id);
const [face, note, voice] = [byId("face"), byId("note"), byId("phones")];
let comparison = null; // the newest one: { rivals: [{ face, lips: input and FAPs }], empty while they load }
let comparedNode = null; // audio node whose sound the rivals receive

for (const head of HEADS) {
  const button = document.createElement("button");
  button.setAttribute("role", "radio");
  button.innerHTML = `<img src="heads/${head}.webp" alt="${head}">`;
  button.onclick = () => showHead(head);
  button.dataset.head = head;
  byId("heads").append(button);
}
showHead(HEADS[0]);

face.addEventListener("notice", ({ detail }) => (note.textContent = detail));
face.addEventListener("error", ({ message }) => (note.textContent = message));

byId("microphone").onclick = () =>
  runAction(async (lips) => {
    if (byId("microphone").ariaPressed === "true") {
      lips.stop();
      setMicrophone(false);
      return;
    }
    await lips.listenToMicrophone();
    setMicrophone(true);
  });
byId("final").onclick = () => runAction(setFinalPhones);
byId("compare").onclick = () => runAction(comparison ? stopComparing : startComparing);
byId("sample").onclick = () => runAction((lips) => play(lips, "sample.wav"));
byId("file").onchange = ({ target }) => {
  openFile(target.files[0]);
  target.value = "";
};

document.body.ondragover = (event) => {
  event.preventDefault();
  document.body.classList.add("dropping");
};
document.body.ondragleave = () => document.body.classList.remove("dropping");
document.body.ondrop = (event) => {
  event.preventDefault();
  document.body.classList.remove("dropping");
  openFile(event.dataTransfer.files[0]);
};

prepare();
navigator.serviceWorker?.register("service-worker.js");

/** Turn final phones on or off, which reloads the lip sync. */
async function setFinalPhones(lips) {
  const isOn = byId("final").ariaPressed !== "true";
  if (comparison) stopComparing();
  lips.stop();
  setMicrophone(false);
  byId("final").ariaPressed = String(isOn);
  note.textContent = "Loading";
  if (isOn) face.setAttribute("phones", "final");
  else face.removeAttribute("phones");
  await prepare();
  note.textContent = "";
}

/** Load the lip sync, and show its visemes and the state of the voice. */
async function prepare() {
  const loading = face.lips;
  const lips = await loading;
  lips.addEventListener("voice", ({ detail: { isSpeaking, isLaughing } }) => {
    voice.textContent = isLaughing ? "Laughter" : isSpeaking ? "Speech" : "Silence";
  });
  const phones = new Map(); // symbols by index
  lips.addEventListener("phone", ({ detail: { index, symbol, durationS } }) => {
    if (index === 0) phones.clear(); // a new sound
    phones.set(index, durationS > 0 && symbol !== "sil" ? symbol : "");
    voice.textContent = [...phones.values()].filter(Boolean).slice(-NUM_PHONES).join(" ");
  });
  const items = [];
  byId("visemes").replaceChildren();
  const show = () => {
    if (face.lips !== loading) return; // replaced in the meantime
    requestAnimationFrame(show);
    const weights = lips.current?.oculus;
    if (!weights) return;
    while (items.length < weights.length) {
      const item = document.createElement("li");
      item.textContent = lips.names.oculus[items.length];
      items.push(item);
      byId("visemes").append(item);
    }
    items.forEach((item, i) => item.style.setProperty("--weight", weights[i].toFixed(2)));
  };
  show();
}

/** Show HeadAudio and wLipSync next to this package. */
async function startComparing(lips) {
  const started = { rivals: [] };
  setComparison(started);
  const rivals = [];
  try {
    const { headAudio, wLipSync } = await import("./rivals.js");
    for (const [title, start] of Object.entries({ HeadAudio: headAudio, wLipSync })) {
      const rival = Object.assign(document.createElement("kouxing-face"), { title });
      rival.setAttribute("manual", "");
      rivals.push({ face: rival, lips: await start(lips.context) });
    }
  } catch (error) {
    if (comparison === started) setComparison(null);
    throw error;
  }
  if (comparison !== started) return; // stopped in the meantime
  const [first, second] = rivals;
  byId("faces").prepend(first.face);
  byId("faces").append(second.face);
  started.rivals = rivals;
  setRivalHeads();
  showRivals(lips, started);
}

function stopComparing() {
  for (const { face: rival, lips: { node } } of comparison.rivals) {
    rival.remove();
    comparedNode?.disconnect(node);
  }
  comparedNode = null;
  setComparison(null);
}

function setComparison(newest) {
  comparison = newest;
  byId("compare").ariaPressed = String(newest !== null);
  document.body.classList.toggle("comparing", newest !== null);
}

/** Give the rivals the same head. FAPs move it, so an avatar cannot show them. */
function setRivalHeads() {
  const head = face.getAttribute("src");
  const src = head.startsWith("heads/") ? head : `heads/${HEADS[0]}.glb`;
  for (const { face: rival } of comparison?.rivals ?? []) rival.setAttribute("src", src);
}

/** Show the rivals' faces for each image, and let them follow the current source. */
function showRivals(lips, shown) {
  if (comparison !== shown) return;
  requestAnimationFrame(() => showRivals(lips, shown));
  if (lips.node !== comparedNode) {
    for (const { lips: { node } } of shown.rivals) {
      comparedNode?.disconnect(node);
      lips.node?.connect(node);
    }
    comparedNode = lips.node;
  }
  for (const { face: rival, lips: rivalLips } of shown.rivals) rival.show(rivalLips.faps());
}

/** Run an action on the lip sync; show its error message. */
async function runAction(action) {
  note.textContent = "";
  try {
    await action(await face.lips);
  } catch (error) {
    if (error.name !== "AbortError") note.textContent = error.message;
  }
}

async function play(lips, url) {
  setMicrophone(false);
  const answer = await fetch(url);
  let buffer;
  try {
    buffer = await lips.context.decodeAudioData(await answer.arrayBuffer());
  } catch {
    throw new Error("the browser cannot read this file; choose a WAV, MP3, M4A or OGG file");
  }
  await lips.listenTo(buffer);
}

/** Show an avatar, or play a sound. */
function openFile(file) {
  if (!file) return;
  const url = URL.createObjectURL(file);
  if (AVATAR.test(file.name)) {
    markHead("");
    face.setAttribute("src", url);
  } else runAction((lips) => play(lips, url));
}

function showHead(head) {
  markHead(head);
  face.setAttribute("src", `heads/${head}.glb`);
  setRivalHeads();
}

/** Mark the button of a head; no button for "". */
function markHead(head) {
  note.textContent = "";
  for (const button of byId("heads").children) button.ariaChecked = String(button.dataset.head === head);
}

function setMicrophone(isOn) {
  byId("microphone").ariaPressed = String(isOn);
}
