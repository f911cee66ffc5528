// The head: a GLB whose morph targets and joints are named after FAPs, as written by
// services/driver/head/glb_export.py.

import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { DrawRate, ImageQueue, drawsInSoftware } from "./draw-rate.js";
import { findJoints, rotateJoints } from "./joints.js";
import {
  loadLight,
  physicalMaterial,
  plainMaterial,
  release,
  setLight,
  studioEnvironment,
} from "./materials.js";
import { MorphedMesh } from "./morph.js";
import { mouthLight } from "./mouth-light.js";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

const MOUTH_PARTS = ["teeth_upper", "teeth_lower", "tongue"]; // lit through the lips
const DRAWN_AFTER_HAIR = ["brows", "lashes"]; // the hair may be behind them
const OVERLAY_FRACTION = 0.6; // fraction of the overlay that the head avoids
const HEAD_HALF_WIDTH = 0.3; // relative to the window's height
const PORTRAIT_ASPECT = 0.66; // in narrower windows the camera moves back, so that the face fits

export class Head {
  #renderer;
  #overlays;
  #scene = new THREE.Scene();
  #camera = new THREE.PerspectiveCamera(22, 1, 0.05, 10);
  #controls;
  #model = null; // the model in the scene
  #meshes = []; // moved by FAPs
  #mouthMaterials = []; // materials of teeth and tongue
  #joints = [];
  #faps = null; // the face of the next image
  #front = new THREE.Vector3(); // initial position of the camera
  #fovYDegrees = 22;
  #needsDrawing = true;
  #isSoftware; // the processor draws
  drawRate; // decides when images are drawn
  #images;
  #isFilmed = false;
  #size = [0, 0]; // size on the page, pixels

  /** @param canvas to draw on; @param overlays { controls, panel } that may cover its lower part */
  constructor(canvas, overlays) {
    this.#overlays = overlays;
    // Edges are smoothed by drawing more pixels than the screen has. Multisampling would speckle a
    // mesh whose triangles are as small as pixels.
    this.#renderer = new THREE.WebGLRenderer({ canvas, antialias: false, alpha: true });
    const gl = this.#renderer.getContext();
    this.#isSoftware = drawsInSoftware(gl);
    const fullRatio = Math.min(2, Math.max(1.5, devicePixelRatio));
    this.drawRate = this.#isSoftware
      ? new DrawRate({ ratio: 0.5, maxRatio: 1, pauses: true })
      : new DrawRate({ ratio: fullRatio, pauses: false });
    this.#images = new ImageQueue(gl, this.drawRate);
    if (!this.#isSoftware) this.#addLights();
    this.#controls = new OrbitControls(this.#camera, canvas);
    this.#controls.enablePan = false;
    this.#controls.minAzimuthAngle = -1.2;
    this.#controls.maxAzimuthAngle = 1.2;
    this.#controls.minPolarAngle = 1.1;
    this.#controls.maxPolarAngle = 1.9;
    this.#controls.addEventListener("change", () => (this.#needsDrawing = true));
    const observer = new ResizeObserver(() => {
      this.#resize();
      this.#render();
    });
    observer.observe(canvas);
    observer.observe(overlays.panel); // it opens and closes
  }

  /** Load a head and replace the current one. */
  async load(url) {
    const [gltf] = await Promise.all([new GLTFLoader().loadAsync(url), loadLight()]);
    if (!gltf.scene.getObjectByName("kouxing")?.userData.kouxing) throw new Error("it is not an exported head");
    if (this.#isSoftware) await coarsen(gltf);
    this.#model?.removeFromParent();
    this.#model?.traverse(({ geometry, material }) => {
      geometry?.dispose();
      if (material) release(material);
    });
    this.#meshes = [];
    this.#mouthMaterials = [];
    this.#add(gltf);
  }

  #add(gltf) {
    this.#model = gltf.scene;
    const info = gltf.scene.getObjectByName("kouxing").userData.kouxing;
    const plain = this.#isSoftware || info.cel;
    gltf.scene.traverse((node) => {
      if (!node.isMesh) return;
      node.frustumCulled = false; // its bounds do not follow the face
      node.renderOrder = DRAWN_AFTER_HAIR.includes(node.name) ? 1 : 0;
      node.material = plain
        ? plainMaterial(node.name, node.material, gltf.scene.getObjectByName("head"), info.cel)
        : physicalMaterial(node.name, node.material);
      if (MOUTH_PARTS.includes(node.name)) this.#mouthMaterials.push(node.material);
      if (node.morphTargetDictionary) this.#meshes.push(new MorphedMesh(node, info.faps));
    });
    this.#joints = findJoints(gltf.scene, info.faps);
    this.#scene.add(gltf.scene);
    this.#setCamera(info.camera);
  }

  /** Draw for a video: on a CSS color and with a constant number of pixels. null ends the video. */
  film(color) {
    this.#isFilmed = color !== null;
    this.#renderer.setClearColor(color ?? 0, color === null ? 0 : 1);
    this.#resize();
    this.#needsDrawing = true;
  }

  /** Set the face of the next image: 68 values in FAP units. */
  pose(faps) {
    this.#faps = faps;
    this.#needsDrawing = true;
  }

  #apply(faps) {
    for (const mesh of this.#meshes) mesh.pose(faps);
    const light = mouthLight(faps);
    for (const material of this.#mouthMaterials) setLight(material, light);
    rotateJoints(this.#joints, faps);
  }

  /** Draw if the face has changed and it is time for an image. */
  draw(nowMs, onVisible) {
    if (!this.#needsDrawing || !this.#images.isDue(nowMs)) return;
    if (this.#renderer.getPixelRatio() !== this.drawRate.ratio) this.#resize(); // this clears the canvas
    this.#needsDrawing = false;
    if (this.#faps !== null) this.#apply(this.#faps);
    this.#faps = null;
    this.#images.draw(nowMs, () => this.#render(), onVisible);
  }

  /**
   * Turn the head to the left and up by degrees, or to the front without arguments. Return
   * { left, up }: its angles, degrees.
   */
  turn(left = null, up = null) {
    const { target, minAzimuthAngle, maxAzimuthAngle, minPolarAngle, maxPolarAngle } = this.#controls;
    const [front, view] = [this.#front, this.#camera.position].map((position) =>
      new THREE.Spherical().setFromVector3(position.clone().sub(target)),
    );
    const { clamp, degToRad, radToDeg } = THREE.MathUtils;
    view.theta = left === null ? front.theta : view.theta + degToRad(left);
    view.phi = up === null ? front.phi : view.phi + degToRad(up);
    view.theta = clamp(view.theta, minAzimuthAngle, maxAzimuthAngle);
    view.phi = clamp(view.phi, minPolarAngle, maxPolarAngle);
    this.#camera.position.setFromSpherical(view).add(target);
    this.#controls.update();
    return { left: radToDeg(view.theta - front.theta), up: radToDeg(view.phi - front.phi) };
  }

  /**
   * Return how the head is drawn: { isCoarse, width, height, numImages, imageMs, isCurrent }.
   *
   * isCoarse is true if the processor draws. The size is in pixels. numImages counts images since
   * the start, and imageMs is the duration of drawing. isCurrent is true if the newest face is drawn.
   */
  get drawing() {
    const { width, height } = this.#renderer.domElement;
    return {
      isCoarse: this.#isSoftware,
      width,
      height,
      numImages: this.#images.numDrawn,
      imageMs: this.drawRate.imageMs,
      isCurrent: !this.#needsDrawing && !this.#images.isDrawing,
    };
  }

  #render() {
    this.#renderer.render(this.#scene, this.#camera);
  }

  #setCamera({ target, position, fovYDegrees }) {
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

  /** Add a key light from the front upper left, fill and rim lights, and a studio environment. */
  #addLights() {
    this.#scene.environment = studioEnvironment(this.#renderer);
    this.#scene.environmentIntensity = 0.6;
    for (const [color, intensity, x, y, z] of [
      [0xfff2e4, 3.0, -0.42, 0.5, 0.8],
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
    // The head fits into the area above the controls, with a small overlap, and left of the panel.
    const { controls, panel } = this.#overlays;
    const { left, height: panelHeight } = panel.getBoundingClientRect();
    const isBelow = left <= 0 && panelHeight > 0;
    const besideWidth = left > 0 ? width - left : 0; // the panel is at the right
    const shiftX = Math.min(besideWidth / 2, Math.max(0, besideWidth + HEAD_HALF_WIDTH * height - width / 2));
    const coveredHeight = isBelow ? panelHeight : controls.offsetHeight * OVERLAY_FRACTION;
    const freeHeight = Math.max(0.5 * height, height - coveredHeight);
    const tangent = Math.tan(THREE.MathUtils.degToRad(this.#fovYDegrees / 2));
    const wideTangent = tangent * Math.max(height / freeHeight, PORTRAIT_ASPECT * (height / width));
    this.#camera.fov = THREE.MathUtils.radToDeg(2 * Math.atan(wideTangent));
    this.#camera.aspect = width / height;
    this.#camera.setViewOffset(width, height, shiftX, (height - freeHeight) / 2, width, height);
    this.#needsDrawing = true;
    if (this.#isFilmed) return;
    this.#renderer.setPixelRatio(this.drawRate.ratio);
    this.#renderer.setSize(width, height, false);
  }
}

/** Replace the triangles with the coarser ones in the file, for drawing without a graphics card. */
async function coarsen(gltf) {
  const meshes = [];
  gltf.scene.traverse((node) => {
    if (node.userData.coarse !== undefined) meshes.push(node);
  });
  for (const { geometry, userData } of meshes) {
    const index = await gltf.parser.getDependency("accessor", userData.coarse);
    const count = 1 + index.array.reduce((max, vertex) => Math.max(max, vertex), 0);
    geometry.setIndex(index); // it uses only the first `count` vertices
    const { attributes, morphAttributes } = geometry;
    for (const name in attributes) attributes[name] = truncate(attributes[name], count);
    morphAttributes.position = morphAttributes.position?.map((target) => truncate(target, count));
  }
}

function truncate({ array, itemSize, normalized }, count) {
  return new THREE.BufferAttribute(array.subarray(0, count * itemSize), itemSize, normalized);
}
