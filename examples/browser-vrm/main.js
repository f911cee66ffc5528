// A VRM avatar in the browser follows a live session, with three-vrm and the gateway's WebSocket.
//
// index.html?avatar=my.vrm&gateway=ws://127.0.0.1:8080&session=NAME (default: the newest session)

import { VRMLoaderPlugin, VRMUtils } from "@pixiv/three-vrm";
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";

const FAP_FRAME = 1; // types of binary messages, proto/GATEWAY.md
const FACE_AT_REST = 3;
const WEIGHTS = [4, 5]; // of a frame, of the face at rest
const HEADER_BYTES = 16;
const HEAD_ROTATION = [47, 48, 49]; // indices of FAPs 48 to 50: pitch, yaw, roll
const RADIANS_PER_UNIT = 1e-5;
const RETRY_MS = 1000;

const query = new URLSearchParams(location.search);
const note = document.getElementById("note");
const renderer = new THREE.WebGLRenderer({
  canvas: document.querySelector("canvas"),
  antialias: true,
  alpha: true,
});
const scene = new THREE.Scene();
const camera = new THREE.PerspectiveCamera(22, 1, 0.05, 20);

const loader = new GLTFLoader();
loader.register((parser) => new VRMLoaderPlugin(parser));
const { vrm } = (await loader.loadAsync(query.get("avatar") ?? "avatar.vrm")).userData;
VRMUtils.rotateVRM0(vrm); // models of version 0 face the other way
const expressions = vrm.expressionManager;
const head = vrm.humanoid.getNormalizedBoneNode("head");
scene.add(vrm.scene, new THREE.HemisphereLight(0xffffff, 0xa0a4b0, 2.2));
const light = new THREE.DirectionalLight(0xffffff, 2.4);
light.position.set(-0.5, 2.2, 1.5);
scene.add(light);

const face = head.getWorldPosition(new THREE.Vector3()).add(new THREE.Vector3(0, 0.05, 0));
camera.position.copy(face).add(new THREE.Vector3(0.1, 0.03, 1.1));
camera.lookAt(face);

/** Follow the session; reconnect while the page is open. */
function connect() {
  const url = new URL("/viewer", query.get("gateway") ?? "ws://127.0.0.1:8080");
  url.searchParams.set("session", query.get("session") ?? "");
  // Avatars with "Perfect Sync" have ARKit's 52 shapes, others have only VRM's shapes.
  url.searchParams.set("shapes", expressions.getExpression("jawOpen") ? "arkit" : "vrm");
  const socket = new WebSocket(url);
  socket.binaryType = "arraybuffer";
  let names = [];
  socket.onmessage = ({ data }) => {
    if (typeof data === "string") {
      const message = JSON.parse(data);
      if (message.type === "shapes") names = message.names;
      if (message.type === "session") note.textContent = message.session ?? "no session; start one in the gateway's page";
      if (message.type === "error") note.textContent = message.text;
      return;
    }
    const type = new DataView(data).getUint8(0);
    if (type === FAP_FRAME || type === FACE_AT_REST) rotateHead(new Float32Array(data, HEADER_BYTES));
    if (WEIGHTS.includes(type)) show(names, new Float32Array(data, HEADER_BYTES));
  };
  socket.onclose = () => {
    note.textContent = "cannot connect to the gateway; run: kouxing run --set gateway.allowed_origins=" + location.origin;
    setTimeout(connect, RETRY_MS);
  };
}

function show(names, weights) {
  names.forEach((name, index) => expressions.setValue(name, weights[index]));
}

function rotateHead(faps) {
  const [pitch, yaw, roll] = HEAD_ROTATION.map((index) => faps[index] * RADIANS_PER_UNIT);
  head.rotation.set(pitch, yaw, roll, "YXZ");
}

const clock = new THREE.Clock();
renderer.setAnimationLoop(() => {
  const { clientWidth: width, clientHeight: height } = renderer.domElement;
  renderer.setSize(width, height, false);
  camera.aspect = width / height;
  camera.updateProjectionMatrix();
  vrm.update(clock.getDelta());
  renderer.render(scene, camera);
});
connect();
window.avatar = { vrm, show }; // for the console and the tests
