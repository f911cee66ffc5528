// <kouxing-face>: a GLB or VRM that speaks as a session does, or as a recording.

import * as THREE from "three";
import { NUM_FAPS } from "./page/messages.js";
import { Pace } from "./page/pace.js";
import { Pictures, drawsInSoftware } from "./page/pictures.js";
import { FapTrack, Playout } from "./page/playout.js";
import { Presence } from "./page/presence.js";
import { Sound } from "./page/sound.js";
import { loadPuppet } from "./puppet.js";
import { readRecording } from "./recording.js";
import { Viewer } from "./viewer.js";

const FOV_DEGREES = 20;
const RATE_HZ = 16000;
const MAX_STEP_S = 0.1; // of hair that swings

/** The element; README.md has its attributes. */
export class KouxingFace extends HTMLElement {
  static observedAttributes = ["src", "gateway", "session", "token", "recording"];
  #renderer = null;
  #pace = null;
  #pictures = null;
  #scene = new THREE.Scene();
  #camera = new THREE.PerspectiveCamera(FOV_DEGREES, 1, 0.01, 100);
  #resized = new ResizeObserver(() => this.#resize());
  #puppet = null;
  #number = 0; // of the newest load
  #link = null;
  #playout = new Playout();
  #track = new FapTrack();
  #presence = new Presence();
  #sound = new Sound(() => {});
  #values = null; // of the puppet's set, as shown
  #names = [];
  #rest = null; // values while nobody speaks
  #recording = null; // { frames, names, nowS, ended }
  #drawnMs = 0;
  #drawing = 0;

  constructor() {
    super();
    const canvas = document.createElement("canvas");
    canvas.style.cssText = "display: block; width: 100%; height: 100%";
    const style = document.createElement("style");
    style.textContent = ":host { display: block; aspect-ratio: 1; contain: strict }";
    this.attachShadow({ mode: "open" }).append(style, canvas);
    this.#scene.add(new THREE.HemisphereLight(0xffffff, 0x8d8d99, 2));
    const key = new THREE.DirectionalLight(0xfff4ea, 2);
    key.position.set(-1, 1, 2);
    this.#scene.add(key);
  }

  connectedCallback() {
    const canvas = this.shadowRoot.querySelector("canvas");
    this.#renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    const gl = this.#renderer.getContext();
    const ratio = Math.min(2, devicePixelRatio);
    this.#pace = new Pace(ratio, ratio, drawsInSoftware(gl));
    this.#pictures = new Pictures(gl, this.#pace);
    this.#resized.observe(this);
    this.#drawing = requestAnimationFrame((nowMs) => this.#draw(nowMs));
    this.#load();
  }

  disconnectedCallback() {
    cancelAnimationFrame(this.#drawing);
    this.#number++;
    this.#resized.disconnect();
    this.#disconnect();
    this.#renderer.dispose();
    this.#renderer = null;
  }

  attributeChangedCallback(name) {
    if (this.#renderer === null) return;
    if (name === "src") this.#load();
    else this.#connect();
  }

  /** What moves the model: "faps", "arkit", "oculus" or "vrm"; null until it is loaded. */
  get set() {
    return this.#puppet?.set ?? null;
  }

  /** The values that are shown: weights by name, or 68 FAPs; null until there are some. */
  get shown() {
    if (this.#values === null) return null;
    if (this.set === "faps") return [...this.#values];
    return Object.fromEntries(this.#names.map((name, i) => [name, this.#values[i]]));
  }

  /** Let the session be heard; call it from a click. */
  async turnSoundOn() {
    await this.#sound.turnOn();
  }

  turnSoundOff() {
    this.#sound.turnOff();
  }

  /**
   * Play the recording.
   *
   * @param audio an HTMLAudioElement that plays its sound; without one it is silent
   * @returns a promise that is fulfilled at its end, or when another begins
   */
  async play(audio = null) {
    const { names, frames } = readRecording(await (await fetch(this.getAttribute("recording"))).text());
    const beganMs = performance.now();
    await audio?.play();
    await new Promise((ended) => {
      this.#recording?.ended();
      const nowS = () => (audio ? audio.currentTime : (performance.now() - beganMs) / 1000);
      this.#recording = { names, frames, nowS, ended };
    });
  }

  async #load() {
    const [number, url] = [++this.#number, this.getAttribute("src")];
    this.#disconnect();
    if (this.#puppet) this.#scene.remove(this.#puppet.scene);
    this.#puppet = null;
    if (!url) return;
    try {
      const puppet = await loadPuppet(url);
      if (number !== this.#number) return; // another one is wanted since
      this.#puppet = puppet;
    } catch (error) {
      this.dispatchEvent(new ErrorEvent("error", { error, message: error.message }));
      return;
    }
    const { scene, view } = this.#puppet;
    this.#scene.add(scene);
    const distance = view.height / 2 / Math.tan(THREE.MathUtils.degToRad(FOV_DEGREES / 2));
    this.#camera.position.copy(view.target).add(new THREE.Vector3(0, 0, distance));
    this.#camera.lookAt(view.target);
    this.dispatchEvent(new Event("load"));
    this.#connect();
  }

  #connect() {
    this.#disconnect();
    if (this.#puppet === null || this.hasAttribute("recording")) return;
    const [session, token] = ["session", "token"].map((name) => this.getAttribute(name) ?? "");
    const shapes = this.set === "faps" ? "" : this.set;
    const gateway = this.getAttribute("gateway") ?? location.origin;
    const frame = (mediaTime, values) => {
      const nowMs = performance.now();
      if (this.#track.push(mediaTime, values)) this.#playout.frameArrived(nowMs, mediaTime);
      this.#presence.frameArrived(nowMs);
    };
    const source = shapes
      ? {
          weights: (mediaTime, weights, names) => {
            this.#names = names;
            frame(mediaTime, weights);
          },
          restWeights: (weights, names) => {
            this.#names = names;
            this.#rest = weights;
          },
        }
      : { frame, rest: (values) => (this.#rest = values) };
    const handlers = {
      ...source,
      sound: (mediaTime, samples) => {
        const nowMs = performance.now();
        this.#playout.soundArrived(nowMs, mediaTime, samples.length);
        this.#keepTime(nowMs);
        this.#sound.push(mediaTime, samples);
      },
      session: (message) => {
        if (message.session !== null) this.#forget();
        this.dispatchEvent(new CustomEvent("session", { detail: message }));
      },
      phone: (message) => this.dispatchEvent(new CustomEvent("phone", { detail: message })),
      error: ({ text }) => this.dispatchEvent(new ErrorEvent("error", { message: text })),
    };
    this.#link = new Viewer(gateway, handlers, { session, token, shapes });
  }

  #disconnect() {
    this.#link?.close();
    this.#link = null;
    this.#recording?.ended();
    this.#recording = this.#rest = this.#values = null;
    this.#names = [];
    this.#forget();
  }

  #forget() {
    this.#playout.reset();
    this.#track.reset();
  }

  #draw(nowMs) {
    this.#drawing = requestAnimationFrame((nextMs) => this.#draw(nextMs));
    this.#playout.pictureMs = this.#pace.untilSeenMs;
    this.#keepTime(nowMs);
    if (this.#puppet === null || !this.#pictures.isDue(nowMs)) return;
    if (this.#renderer.getPixelRatio() !== this.#pace.ratio) this.#resize();
    if (this.#recording) this.#poseRecording();
    else this.#poseStream(nowMs);
    this.#puppet.update(Math.min(MAX_STEP_S, (nowMs - this.#drawnMs) / 1000));
    this.#drawnMs = nowMs;
    this.#pictures.draw(nowMs, () => this.#renderer.render(this.#scene, this.#camera));
  }

  /** Keep sound and picture in step; where the page is hidden and nothing drawn, as sound arrives. */
  #keepTime(nowMs) {
    this.#playout.isHeard = this.#sound.isPlaying;
    this.#playout.outputLatencyMs = this.#sound.outputLatencyMs;
    this.#playout.adjust(nowMs);
    if (this.#playout.offsetMs !== null) this.#sound.align(nowMs, this.#playout.offsetMs);
  }

  #poseStream(nowMs) {
    const mediaTime = this.#playout.mediaAt(nowMs + this.#playout.pictureMs); // when it is seen
    const values = new Float32Array(this.#names.length || NUM_FAPS);
    const speaks = mediaTime !== null && this.#track.sample(mediaTime, values) !== null;
    const share = this.#presence.update(nowMs, speaks);
    const rest = this.#rest;
    if (speaks || rest) this.#show(speaks ? mix(rest ?? values, values, share) : rest, this.#names);
  }

  #poseRecording() {
    const { names, frames, nowS, ended } = this.#recording;
    const mediaTime = (nowS() + this.#pace.untilSeenMs / 1000) * RATE_HZ;
    const next = frames.findIndex(([time]) => time > mediaTime);
    if (next === -1) {
      this.#show(frames.at(-1)[1], names ?? []);
      this.#recording = null;
      ended();
      return;
    }
    const between = new FapTrack();
    for (const [time, values] of frames.slice(Math.max(0, next - 1), next + 1)) between.push(time, values);
    const values = new Float32Array(frames[0][1].length);
    between.sample(mediaTime, values);
    this.#show(values, names ?? []);
  }

  #show(values, names) {
    this.#values = values;
    this.#names = names;
    this.#puppet.pose(values, names);
  }

  #resize() {
    const { clientWidth, clientHeight } = this;
    if (clientWidth === 0 || clientHeight === 0) return;
    this.#renderer.setPixelRatio(this.#pace.ratio);
    this.#renderer.setSize(clientWidth, clientHeight, false);
    this.#camera.aspect = clientWidth / clientHeight;
    this.#camera.updateProjectionMatrix();
  }
}

function mix(rest, speaking, share) {
  return speaking.map((value, i) => rest[i] + share * (value - rest[i]));
}

customElements.define("kouxing-face", KouxingFace);
