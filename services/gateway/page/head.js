// The head: a GLB whose morph targets and joints are named by FAPs (services/driver/head/glb_export.py).

import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { coarsen } from "./coarse.js";
import { findJoints, turnJoints } from "./joints.js";
import { dim, physicalMaterial, plainMaterial, release, studio } from "./materials.js";
import { MorphedMesh } from "./morph.js";
import { mouthLight } from "./mouth-light.js";
import { Pace } from "./pace.js";
import { Pictures, drawsInSoftware } from "./pictures.js";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

const IN_MOUTH = ["teeth_upper", "teeth_lower", "tongue"]; // lit through the lips
const OVERLAY_SHARE = 0.6;
const PORTRAIT_ASPECT = 0.66; // narrower windows step back, so that the face still fits

export class Head {
  #renderer;
  #overlay;
  #scene = new THREE.Scene();
  #camera = new THREE.PerspectiveCamera(22, 1, 0.05, 10);
  #controls;
  #model = null; // in the scene
  #meshes = []; // that FAPs move
  #inMouth = []; // materials
  #joints = [];
  #faps = null; // to be taken on
  #front = new THREE.Vector3(); // where the camera stands at first
  #fovYDegrees = 22;
  #stale = true;
  #software; // the processor draws
  #pace;
  #pictures;
  #isFilmed = false;
  #size = [0, 0]; // on the page

  /** @param canvas to draw into; @param overlay the element that covers its lower edge */
  constructor(canvas, overlay) {
    this.#overlay = overlay;
    // Smooth edges come from more pixels than the screen has: multisampling speckles a mesh whose
    // triangles are as small as pixels.
    this.#renderer = new THREE.WebGLRenderer({ canvas, antialias: false, alpha: true });
    const gl = this.#renderer.getContext();
    this.#software = drawsInSoftware(gl);
    const full = Math.min(2, Math.max(1.5, devicePixelRatio));
    this.#pace = this.#software ? new Pace(0.5, 1, true) : new Pace(full, full, false);
    this.#pictures = new Pictures(gl, this.#pace);
    if (!this.#software) this.#light();
    this.#controls = new OrbitControls(this.#camera, canvas);
    this.#controls.enablePan = false;
    this.#controls.minAzimuthAngle = -1.2;
    this.#controls.maxAzimuthAngle = 1.2;
    this.#controls.minPolarAngle = 1.1;
    this.#controls.maxPolarAngle = 1.9;
    this.#controls.addEventListener("change", () => (this.#stale = true));
    new ResizeObserver(() => {
      this.#resize();
      this.#render();
    }).observe(canvas);
  }

  /** Load a head, in place of the one before. */
  async load(url) {
    const gltf = await new GLTFLoader().loadAsync(url);
    if (this.#software) await coarsen(gltf);
    this.#model?.removeFromParent();
    this.#model?.traverse(({ geometry, material }) => {
      geometry?.dispose();
      if (material) release(material);
    });
    this.#meshes = [];
    this.#inMouth = [];
    this.#add(gltf);
  }

  #add(gltf) {
    this.#model = gltf.scene;
    const about = gltf.scene.getObjectByName("kouxing").userData.kouxing;
    const plain = this.#software || about.cel;
    gltf.scene.traverse((node) => {
      if (!node.isMesh) return;
      node.frustumCulled = false; // bounds do not follow the face
      node.material = plain
        ? plainMaterial(node.name, node.material, gltf.scene.getObjectByName("head"), about.cel)
        : physicalMaterial(node.name, node.material);
      if (IN_MOUTH.includes(node.name)) this.#inMouth.push(node.material);
      if (node.morphTargetDictionary) this.#meshes.push(new MorphedMesh(node, about.faps));
    });
    this.#joints = findJoints(gltf.scene, about.faps);
    this.#scene.add(gltf.scene);
    this.#frame(about.camera);
  }

  /**
   * Draw for a film, before a CSS colour, with as many pixels as now to its end; null: for the page
   * again.
   */
  film(color) {
    this.#isFilmed = color !== null;
    this.#renderer.setClearColor(color ?? 0, color === null ? 0 : 1);
    this.#resize();
    this.#stale = true;
  }

  /** Take on a face with the next picture: 68 values in FAP units. */
  pose(faps) {
    this.#faps = faps;
    this.#stale = true;
  }

  #apply(faps) {
    for (const mesh of this.#meshes) mesh.pose(faps);
    const light = mouthLight(faps);
    for (const material of this.#inMouth) dim(material, light);
    turnJoints(this.#joints, faps);
  }

  /**
   * Draw, if anything has changed and it is time for a picture.
   *
   * @param seen called with when this picture is seen first, ms, if it is drawn
   */
  draw(nowMs, seen) {
    if (!this.#stale || !this.#pictures.isDue(nowMs)) return;
    if (this.#renderer.getPixelRatio() !== this.#pace.ratio) this.#resize(); // which blanks the canvas
    this.#stale = false;
    if (this.#faps !== null) this.#apply(this.#faps);
    this.#faps = null;
    this.#pictures.draw(nowMs, () => this.#render(), seen);
  }

  /**
   * Turn the head in the picture, to the left and up, degrees; without any: to the front. Return how
   * far it is turned.
   */
  turn(left = null, up = null) {
    const { target, minAzimuthAngle, maxAzimuthAngle, minPolarAngle, maxPolarAngle } = this.#controls;
    const [front, place] = [this.#front, this.#camera.position].map((position) =>
      new THREE.Spherical().setFromVector3(position.clone().sub(target)),
    );
    const { clamp, degToRad, radToDeg } = THREE.MathUtils;
    place.theta = left === null ? front.theta : place.theta + degToRad(left);
    place.phi = up === null ? front.phi : place.phi + degToRad(up);
    place.theta = clamp(place.theta, minAzimuthAngle, maxAzimuthAngle);
    place.phi = clamp(place.phi, minPolarAngle, maxPolarAngle);
    this.#camera.position.setFromSpherical(place).add(target);
    this.#controls.update();
    return { left: radToDeg(place.theta - front.theta), up: radToDeg(place.phi - front.phi) };
  }

  /** How long after it is drawn a picture is seen, ms, to the middle of the time for which it is. */
  get untilSeenMs() {
    return this.#pace.untilSeenMs;
  }

  /**
   * How it is drawn: { isCoarse: as the processor draws it, width, height: in pixels, numPictures:
   * until now, pictureMs: that one takes }.
   */
  get drawing() {
    const { width, height } = this.#renderer.domElement;
    return {
      isCoarse: this.#software,
      width,
      height,
      numPictures: this.#pictures.numDrawn,
      pictureMs: this.#pace.pictureMs,
    };
  }

  #render() {
    this.#renderer.render(this.#scene, this.#camera);
  }

  #frame({ target, position, fovYDegrees }) {
    this.#fovYDegrees = fovYDegrees;
    this.#front.set(...position);
    this.#camera.position.copy(this.#front);
    this.#controls.target.set(...target);
    const distance = this.#camera.position.distanceTo(this.#controls.target);
    this.#controls.minDistance = 0.5 * distance;
    this.#controls.maxDistance = 1.5 * distance;
    this.#controls.update();
    this.#resize();
  }

  /** A key from the front upper left, a rim, and the light of a studio. */
  #light() {
    this.#scene.environment = studio(this.#renderer);
    this.#scene.environmentIntensity = 0.8;
    for (const [color, intensity, x, y, z] of [
      [0xfff2e4, 2.7, -0.42, 0.5, 0.8],
      [0xe6eeff, 0.6, 0.75, 0.1, 0.6],
      [0xffffff, 0.9, 0.55, 0.45, -0.7],
    ]) {
      const light = new THREE.DirectionalLight(color, intensity);
      light.position.set(x, y, z);
      this.#scene.add(light);
    }
  }

  #resize() {
    const { clientWidth, clientHeight } = this.#renderer.domElement;
    if (!this.#isFilmed) this.#size = [clientWidth, clientHeight];
    const [width, height] = this.#size;
    if (width === 0 || height === 0) return;
    // The head is fitted into what the controls leave free, a little behind them at most.
    const hidden = this.#overlay.offsetHeight * OVERLAY_SHARE;
    const free = Math.max(0.5 * height, height - hidden);
    const half = Math.tan(THREE.MathUtils.degToRad(this.#fovYDegrees / 2));
    const widened = half * Math.max(height / free, PORTRAIT_ASPECT * (height / width));
    this.#camera.fov = THREE.MathUtils.radToDeg(2 * Math.atan(widened));
    this.#camera.aspect = width / height;
    this.#camera.setViewOffset(width, height, 0, (height - free) / 2, width, height);
    this.#stale = true;
    if (this.#isFilmed) return;
    this.#renderer.setPixelRatio(this.#pace.ratio);
    this.#renderer.setSize(width, height, false);
  }
}
