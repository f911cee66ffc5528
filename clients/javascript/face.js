// <kouxing-face>: a GLB or VRM model that a session, a recording or local lip sync moves.

import { VRMUtils } from "@pixiv/three-vrm";
import * as THREE from "three";
import { Blinks } from "./blinks.js";
import { DrawRate, ImageQueue, drawsInSoftware } from "./page/draw-rate.js";
import { Player } from "./page/player.js";
import { FapTrack } from "./page/playout.js";
import { Sound } from "./page/sound.js";
import { fetchFile, loadPuppet } from "./puppet.js";
import { readRecording, recordingClock } from "./recording.js";
import { chooseSet } from "./shape-names.js";
import { Viewer } from "./viewer.js";

const LOST_WEBGL = "the browser no longer draws this face; show fewer faces, at most about 16 on a page, or reload the page";
const NO_WEBGL = "this browser has no WebGL; turn on hardware acceleration";
const FOV_DEGREES = 20;
const RATE_HZ = 16000;
const NUM_FAPS = 68;
const MAX_STEP_S = 0.1; // longest time step of the hair physics

/** The custom element; README.md lists its attributes. */
export class KouxingFace extends HTMLElement {
  static observedAttributes = ["src", "gateway", "session", "token", "recording", "local", "phones", "manual"];
  #renderer = null;
  #note = Object.assign(document.createElement("p"), { part: "note" }); // the last error
  #drawRate = null;
  #images = null;
  #scene = new THREE.Scene();
  #camera = new THREE.PerspectiveCamera(FOV_DEGREES, 1, 0.01, 100);
  #resizeObserver = new ResizeObserver(() => this.#resize());
  #avatar = null;
  #loadId = 0; // number of the newest load
  #viewer = null;
  #sound = new Sound(() => {});
  #player = new Player(this.#sound);
  #values = null; // shown values of the avatar's set
  #names = [];
  #playId = 0; // number of the newest call of play()
  #recording = null; // { frames, names, nowS, onEnded }
  #lips = null; // a promise of the local lip sync
  #lipsId = 0; // number of the newest local lip sync
  #localFaces = null; // the local faces, once they are loaded
  #blinks = new Blinks();
  #drawnMs = 0;
  #animationFrame = 0;

  constructor() {
    super();
    const style = document.createElement("style");
    style.textContent =
      ":host { display: block; aspect-ratio: 1; contain: strict } p { position: absolute; margin: 1em } canvas { display: block; width: 100%; height: 100% }";
    this.attachShadow({ mode: "open" }).append(style, this.#note);
    this.#scene.add(new THREE.HemisphereLight(0xffffff, 0x8d8d99, 2));
    const key = new THREE.DirectionalLight(0xfff4ea, 2);
    key.position.set(-1, 1, 2);
    this.#scene.add(key);
  }

  connectedCallback() {
    const canvas = document.createElement("canvas");
    canvas.addEventListener("webglcontextlost", () => {
      if (canvas.isConnected) this.#showError(new Error(LOST_WEBGL), LOST_WEBGL);
    });
    canvas.addEventListener("webglcontextrestored", () => (this.#note.textContent = ""));
    this.shadowRoot.append(canvas);
    try {
      this.#renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    } catch (error) {
      this.#showError(error, NO_WEBGL);
      return;
    }
    const gl = this.#renderer.getContext();
    const ratio = Math.min(2, devicePixelRatio);
    this.#drawRate = new DrawRate({ ratio, pauses: drawsInSoftware(gl) });
    this.#images = new ImageQueue(gl, this.#drawRate);
    this.#resizeObserver.observe(this);
    if (this.#sound.isWanted) this.turnSoundOn().catch((error) => this.#showError(error, error.message));
    this.#animationFrame = requestAnimationFrame((nowMs) => this.#draw(nowMs));
    this.#load();
  }

  disconnectedCallback() {
    cancelAnimationFrame(this.#animationFrame);
    this.#loadId++;
    this.#resizeObserver.disconnect();
    this.#disconnect();
    this.#closeLips();
    this.#sound.close();
    this.#removeAvatar();
    this.#images?.close();
    this.#renderer?.dispose();
    this.#renderer?.forceContextLoss(); // a page may have about 16, and a removed element may stay in memory
    this.#renderer = null;
    this.shadowRoot.querySelector("canvas").remove();
  }

  attributeChangedCallback(name) {
    if (this.#renderer === null) return;
    if (name === "local" || name === "phones") this.#closeLips();
    if (name === "src") this.#load();
    else this.#connect();
  }

  /** Set of values that moves the model: "faps", "arkit", "oculus" or "vrm"; null before loading. */
  get set() {
    return this.#avatar?.set ?? null;
  }

  /** The shown values: weights by name, or 68 FAPs; null before the first. */
  get shown() {
    if (this.#values === null) return null;
    if (this.set === "faps") return [...this.#values];
    return Object.fromEntries(this.#names.map((name, i) => [name, this.#values[i]]));
  }

  /** Turn the session's sound on. Call it from a click handler. */
  async turnSoundOn() {
    await this.#sound.turnOn();
  }

  turnSoundOff() {
    this.#sound.turnOff();
  }

  /** Show values: 68 FAPs, or weights with their names. Nothing happens before the model is loaded. */
  show(values, names = []) {
    if (this.#avatar === null) return;
    const isFaps = this.set === "faps";
    if (values.length !== (isFaps ? NUM_FAPS : names.length) || !values.every(Number.isFinite)) {
      throw new RangeError(`show() needs ${isFaps ? `${NUM_FAPS} FAPs` : "weights with their names"}; all must be finite numbers`);
    }
    this.#show(values, names);
  }

  #show(values, names) {
    this.#values = values;
    this.#names = names;
    this.#avatar.pose(values, names);
  }

  /**
   * Play the recording.
   *
   * @param audio HTMLAudioElement that plays the sound; null for silence
   * @returns a promise that is resolved at the end, or when another recording starts. If the face is removed or gets
   *   another model before the recording starts, it is rejected with an AbortError, which the caller can ignore.
   */
  async play(audio = null) {
    const url = this.getAttribute("recording");
    if (!url) throw new Error("<kouxing-face> needs the attribute recording; add it");
    const avatar = this.#avatar;
    if (avatar === null) throw new Error("the model is not loaded yet; wait for the event load");
    const playId = ++this.#playId;
    const reading = fetchFile(url).then(readRecording);
    const { names, frames } = await reading.catch(({ message }) => {
      throw new Error(`${url}: ${message}`);
    });
    this.#checkAvatar(avatar);
    if (playId !== this.#playId) return;
    const set = names === null ? "faps" : chooseSet(names);
    if (set !== this.set) throw new Error(`the recording moves ${set}, and the model needs ${this.set}; record it again`);
    if (set === "faps" && frames.some(([, values]) => values.length !== NUM_FAPS)) {
      throw new Error(`${url}: a frame needs ${NUM_FAPS} FAPs; record it again`);
    }
    await audio?.play();
    if (this.#avatar !== avatar) audio?.pause();
    this.#checkAvatar(avatar);
    await new Promise((onEnded) => {
      this.#recording?.onEnded();
      const nowS = recordingClock(audio, frames[0][0] / RATE_HZ);
      this.#recording = { names, frames, nowS, onEnded };
    });
  }

  #checkAvatar(avatar) {
    if (this.#avatar !== avatar) throw new DOMException("the face was removed, or its model changed", "AbortError");
  }

  /** The local lip sync: a promise of a LipSync of kouxing-lips. Its sources move the model. */
  get lips() {
    if (!this.hasAttribute("local")) throw new Error("<kouxing-face> needs the attribute local; add it");
    if (!this.isConnected) throw new Error("<kouxing-face> is not in the page; add it to the page first");
    if (this.#lips === null) {
      const loading = this.#loadLips();
      this.#lips = loading;
      loading.catch(() => {
        if (this.#lips === loading) this.#lips = null; // the next call tries again
      });
    }
    return this.#lips;
  }

  async #loadLips() {
    const id = ++this.#lipsId;
    const LipSync = await importLipSync();
    const [models, phones] = ["local", "phones"].map((name) => this.getAttribute(name));
    const lips = await LipSync.create({ shapes: ["arkit", "oculus", "vrm"], ...(models && { models }), ...(phones && { phones }) });
    if (id !== this.#lipsId) {
      lips.close(); // it was closed or replaced while it was loading
      return lips;
    }
    lips.addEventListener("notice", ({ detail }) => this.dispatchEvent(new CustomEvent("notice", { detail })));
    this.#localFaces = lips;
    return lips;
  }

  #closeLips() {
    this.#lipsId++;
    this.#localFaces?.close();
    this.#lips = this.#localFaces = null;
  }

  async #load() {
    const [loadId, url] = [++this.#loadId, this.getAttribute("src")];
    this.#disconnect();
    this.#removeAvatar();
    if (!url) return;
    try {
      const avatar = await loadPuppet(url);
      if (loadId !== this.#loadId) return; // another load has started
      this.#avatar = avatar;
    } catch (error) {
      if (loadId === this.#loadId) this.#showError(error, error.message);
      return;
    }
    this.#note.textContent = "";
    const { scene, view } = this.#avatar;
    this.#scene.add(scene);
    const distance = view.height / 2 / Math.tan(THREE.MathUtils.degToRad(FOV_DEGREES / 2));
    [this.#camera.near, this.#camera.far] = [distance / 100, distance * 100];
    this.#camera.updateProjectionMatrix();
    this.#camera.position.copy(view.target).add(new THREE.Vector3(0, 0, distance));
    this.#camera.lookAt(view.target);
    this.dispatchEvent(new Event("load"));
    this.#connect();
  }

  #removeAvatar() {
    if (this.#avatar === null) return;
    this.#scene.remove(this.#avatar.scene);
    VRMUtils.deepDispose(this.#avatar.scene); // otherwise it stays in the graphics card's memory
    this.#avatar = null;
  }

  #showError(error, message) {
    this.#note.textContent = message;
    this.dispatchEvent(new ErrorEvent("error", { error, message }));
  }

  #connect() {
    this.#disconnect();
    if (this.#avatar === null || this.hasAttribute("recording") || this.hasAttribute("manual")) return;
    if (this.hasAttribute("local")) {
      this.lips.catch((error) => this.#showError(error, error.message));
      return;
    }
    const [session, token] = ["session", "token"].map((name) => this.getAttribute(name) ?? "");
    const shapes = this.set === "faps" ? "" : this.set;
    const gateway = this.getAttribute("gateway") ?? location.origin;
    let shown = { session: null };
    let numFailures = 1; // in a row; if the first attempt after a lost connection succeeds, nothing is reported
    const handlers = {
      connected: (isConnected) => {
        if (this.#viewer === null) return; // closed by this element
        const other = this.hasAttribute("gateway") ? "" : "set the attribute gateway to its address, or ";
        const text = `cannot connect to the gateway at ${gateway}; ${other}start it with: kouxing run --set gateway.trusted_origins=${location.origin}`;
        numFailures = isConnected ? 0 : numFailures + 1;
        if (isConnected) this.#note.textContent = "";
        else if (numFailures === 2) this.#showError(new Error(text), text);
      },
      frame: (mediaTime, faps) => shapes || this.#player.addFrame(mediaTime, faps),
      rest: (faps) => shapes || this.#setRest(faps, []),
      weights: (mediaTime, weights) => this.#player.addFrame(mediaTime, weights),
      restWeights: (weights, names) => this.#setRest(weights, names),
      sound: (mediaTime, samples) => this.#player.addSound(mediaTime, samples),
      session: (message) => {
        // A session whose epoch is lower is a new one with the name of an earlier one.
        const isOther = message.session !== shown.session || message.epoch < shown.epoch;
        shown = message;
        if (shown.session !== null) this.#player.reset(isOther);
        this.dispatchEvent(new CustomEvent("session", { detail: message }));
      },
      phone: (message) => this.dispatchEvent(new CustomEvent("phone", { detail: message })),
      error: ({ text }) => this.dispatchEvent(new ErrorEvent("error", { message: text })),
    };
    try {
      this.#viewer = new Viewer(gateway, handlers, { session, token, shapes });
    } catch (error) {
      this.#showError(error, error.message); // a wrong address
    }
  }

  #disconnect() {
    const viewer = this.#viewer;
    this.#viewer = null;
    viewer?.close();
    this.#recording?.onEnded();
    this.#recording = this.#values = null;
    this.#names = [];
    this.#player.reset(true);
  }

  /** Set the face at rest. The first one starts the player. */
  #setRest(values, names) {
    if (this.#values === null) {
      this.#player = new Player(this.#sound, undefined, values.length);
      this.#values = values;
      this.#names = names;
    }
    this.#player.restFaps = values;
  }

  #draw(nowMs) {
    this.#animationFrame = requestAnimationFrame((nextMs) => this.#draw(nextMs));
    this.#player.update(nowMs, this.#drawRate.visibleDelayMs); // also keeps the sound in sync
    if (this.#avatar === null || !this.#images.isDue(nowMs)) return;
    if (this.#renderer.getPixelRatio() !== this.#drawRate.ratio) this.#resize();
    if (this.#recording) this.#poseRecording();
    else if (this.hasAttribute("local")) this.#poseLocalFace(nowMs);
    else if (this.#viewer !== null && this.#values !== null) this.#show(this.#player.faps, this.#names);
    this.#avatar.update(Math.min(MAX_STEP_S, (nowMs - this.#drawnMs) / 1000));
    this.#drawnMs = nowMs;
    this.#images.draw(nowMs, () => this.#renderer.render(this.#scene, this.#camera));
  }

  #poseLocalFace(nowMs) {
    const face = this.#localFaces?.current;
    if (!face) return;
    const { set } = this;
    const names = this.#localFaces.names[set] ?? [];
    const values = face[set].slice();
    this.#blinks.apply(values, names, nowMs / 1000);
    this.#show(values, names);
  }

  #poseRecording() {
    const { names, frames, nowS, onEnded } = this.#recording;
    const mediaTime = (nowS() + this.#drawRate.visibleDelayMs / 1000) * RATE_HZ;
    const next = frames.findIndex(([time]) => time > mediaTime);
    if (next === -1) {
      this.#show(frames.at(-1)[1], names ?? []);
      this.#recording = null;
      onEnded();
      return;
    }
    const track = new FapTrack();
    for (const [time, values] of frames.slice(Math.max(0, next - 1), next + 1)) track.push(time, values);
    const values = new Float32Array(frames[0][1].length);
    track.sample(mediaTime, values);
    this.#show(values, names ?? []);
  }

  #resize() {
    const { clientWidth, clientHeight } = this;
    if (clientWidth === 0 || clientHeight === 0) return;
    this.#renderer.setPixelRatio(this.#drawRate.ratio);
    this.#renderer.setSize(clientWidth, clientHeight, false);
    this.#camera.aspect = clientWidth / clientHeight;
    this.#camera.updateProjectionMatrix();
  }
}

/**
 * Import the optional package. Bundlers tolerate a missing package only if the import is in a try
 * block.
 */
async function importLipSync() {
  try {
    const { LipSync } = await import("kouxing-lips");
    return LipSync;
  } catch (error) {
    throw new Error(`the attribute local needs the package kouxing-lips; install it (${error.message})`, { cause: error });
  }
}

// A page may load this module twice, for example in two bundles. The first element is kept.
if (!customElements.get("kouxing-face")) customElements.define("kouxing-face", KouxingFace);
