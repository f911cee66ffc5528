// A VRM avatar in the browser follows a live session, with three-vrm and the gateway's WebSocket.
//
// index.html?avatar=my.vrm&gateway=ws://127.0.0.1:8080&session=NAME (default: the newest session)

import { VRMLoaderPlugin, VRMUtils } from "@pixiv/three-vrm";
import * as THREE from "three";
import { MeshoptDecoder } from "three/addons/libs/meshopt_decoder.module.js";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";

const FAP_FRAME = 1; // types of binary messages, proto/GATEWAY.md
const FACE_AT_REST = 3;
const WEIGHTS = [4, 5]; // message types: weights of a frame, weights at rest
const HEADER_BYTES = 16;
const HEAD_ROTATION = [47, 48, 49]; // indices of FAPs 48 to 50: pitch, yaw, roll
const RADIANS_PER_UNIT = 1e-5;
const RETRY_MS = 1000;
const ARKIT_NEEDED = ["jawOpen", "mouthPucker"]; // as in shared/face/shape_names.txt
const VRM_NEEDED = ["aa", "ih", "ou", "ee", "oh"];

const query = new URLSearchParams(location.search);
const note = document.getElementById("note");
const { vrm, renderer } = await start().catch((error) => {
  note.textContent = error.message;
  throw error;
});
const expressions = vrm.expressionManager;
const activeExpressions = (expressions?.expressions ?? []).filter(({ binds }) => binds.length > 0); // some exporters write empty ones
const nameOf = new Map(activeExpressions.map(({ expressionName }) => [normalizeName(expressionName), expressionName]));
const head = vrm.humanoid.getNormalizedBoneNode("head");
const forward = vrm.meta.metaVersion === "0" ? -1 : 1; // the bones of version 0 look along -z
const scene = new THREE.Scene();
const camera = new THREE.PerspectiveCamera(22, 1, 0.05, 20);
scene.add(vrm.scene, new THREE.HemisphereLight(0xffffff, 0xa0a4b0, 2.2));
const light = new THREE.DirectionalLight(0xffffff, 2.4);
light.position.set(-0.5, 2.2, 1.5);
scene.add(light);

const face = head.getWorldPosition(new THREE.Vector3()).add(new THREE.Vector3(0, 0.05, 0));
camera.position.copy(face).add(new THREE.Vector3(0.1, 0.03, 1.1));
camera.lookAt(face);

/** Load the avatar and start WebGL. */
async function start() {
  const loader = new GLTFLoader().setMeshoptDecoder(MeshoptDecoder);
  loader.register((parser) => new VRMLoaderPlugin(parser));
  const file = query.get("avatar") ?? "avatar.vrm";
  const avatar = (await loader.loadAsync(file)).userData.vrm;
  if (!avatar) throw new Error(`${file} is not a VRM avatar`);
  VRMUtils.rotateVRM0(avatar); // models of version 0 face the other way
  const canvas = document.querySelector("canvas");
  try {
    return { vrm: avatar, renderer: new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true }) };
  } catch {
    throw new Error("this browser has no WebGL; turn on hardware acceleration");
  }
}

/** Return one name for JawOpen and jawOpen, mouthSmile_L and mouthSmileLeft. */
function normalizeName(name) {
  return name.replace(/_L$/i, "Left").replace(/_R$/i, "Right").toLowerCase();
}

/** Return the names of a set that no expression has. */
function missingNames(names) {
  return names.filter((name) => !nameOf.has(normalizeName(name)));
}

/** Follow the session; reconnect while the page is open. */
function connect() {
  const gateway = query.get("gateway") ?? "ws://127.0.0.1:8080";
  if (!/^(ws|http)s?:/i.test(gateway)) {
    note.textContent = `${gateway} is not the address of a gateway, such as ws://127.0.0.1:8080`;
    return;
  }
  const url = new URL("/viewer", gateway);
  url.protocol = url.protocol.replace("http", "ws");
  url.searchParams.set("session", query.get("session") ?? "");
  url.searchParams.set("token", query.get("token") ?? "");
  // Avatars with "Perfect Sync" have ARKit's 52 shapes, others have only VRM's shapes.
  const isPerfect = missingNames(ARKIT_NEEDED).length === 0;
  const missingShapes = missingNames(VRM_NEEDED);
  if (!isPerfect && missingShapes[0] === "aa") {
    note.textContent = `the avatar cannot speak: it has no shape ${missingShapes.join(", ")} of VRM; use an avatar with the shapes of ARKit, Oculus or VRM`;
    return;
  }
  url.searchParams.set("shapes", isPerfect ? "arkit" : "vrm");
  const socket = new WebSocket(url);
  socket.binaryType = "arraybuffer";
  let names = [];
  let problem = `cannot connect to the gateway; run: kouxing run --set gateway.trusted_origins=${location.origin}`;
  socket.onopen = () => {
    problem = "the connection to the gateway is lost; connecting again";
  };
  socket.onmessage = ({ data }) => {
    if (typeof data === "string") {
      const message = JSON.parse(data);
      if (message.type === "shapes") names = message.names;
      if (message.type === "session") note.textContent = message.session ?? "no session; start one in the gateway's page";
      if (message.type === "error") note.textContent = problem = message.text;
      return;
    }
    const type = new DataView(data).getUint8(0);
    if (type === FAP_FRAME || type === FACE_AT_REST) rotateHead(new Float32Array(data, HEADER_BYTES));
    if (WEIGHTS.includes(type)) show(names, new Float32Array(data, HEADER_BYTES));
  };
  socket.onclose = () => {
    note.textContent = problem;
    setTimeout(connect, RETRY_MS);
  };
}

function show(names, weights) {
  names.forEach((name, index) => expressions.setValue(nameOf.get(normalizeName(name)), weights[index]));
}

function rotateHead(faps) {
  const [pitch, yaw, roll] = HEAD_ROTATION.map((index) => faps[index] * RADIANS_PER_UNIT);
  head.rotation.set(forward * pitch, yaw, forward * roll, "YXZ");
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
