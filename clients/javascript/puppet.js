// A model that a stream of values moves: kouxing's heads by FAPs, other models by blendshapes.

import { VRMLoaderPlugin, VRMLookAtBoneApplier, VRMUtils } from "@pixiv/three-vrm";
import * as THREE from "three";
import { MeshoptDecoder } from "three/addons/libs/meshopt_decoder.module.js";
import { DRACOLoader } from "three/addons/loaders/DRACOLoader.js";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { FaceRegion } from "./face-region.js";
import { findJoints, rotateJoints } from "./page/joints.js";
import { MorphedMesh } from "./page/morph.js";
import { chooseSet, findShapes } from "./shape-names.js";

const UNREADABLE = { DRACOLoader: "KHR_draco_mesh_compression", KTX2: "KHR_texture_basisu" }; // by words of three.js
const DAMAGED = "it is not a GLB or VRM file, or it is damaged; export it again, or choose another file";
const VIEW_HEIGHT = 1.6; // height of the camera's view, relative to the face
const VRM_FACE_M = 0.24;
const JAW_BONE = /(^|[.:|_ ])(jaw|jawroot|lowerjaw)$/i;
const JAW_RADIANS = 0.3; // at full weight of ARKit's jawOpen
const OPENINGS = { jawOpen: 1, aa: 0.5, oh: 0.35, E: 0.2, ee: 0.2, ou: 0.2 }; // how far each shape opens the jaw
// Rotation of the eyes at weight 1, degrees, and the shapes of the sets "vrm" and "arkit".
const LOOKS = {
  left: [24.6, "lookLeft", "eyeLookOutLeft", "eyeLookInRight"],
  right: [24.6, "lookRight", "eyeLookInLeft", "eyeLookOutRight"],
  down: [17.8, "lookDown", "eyeLookDownLeft", "eyeLookDownRight"],
  up: [12, "lookUp", "eyeLookUpLeft", "eyeLookUpRight"],
};

/**
 * Load a model.
 *
 * @param url of a GLB or VRM file
 * @returns a promise of { scene, set: values that move it ("faps", "arkit", "oculus" or "vrm"),
 *   pose(values, names), update(seconds), view: { target, height } of the face, meters }; it is
 *   rejected if the model cannot be read or cannot speak
 */
export async function loadPuppet(url) {
  try {
    return await readAvatar(url);
  } catch (error) {
    const word = Object.keys(UNREADABLE).find((key) => error.message.includes(key));
    let text = error.message;
    if (word) text = `it needs ${UNREADABLE[word]}, which kouxing does not support; export it without them`;
    if ([SyntaxError, RangeError, TypeError].includes(error.constructor)) text = DAMAGED;
    throw new Error(url.startsWith("blob:") ? `cannot show this file: ${text}` : `${url}: ${text}`, { cause: error });
  }
}

async function readAvatar(url) {
  const loader = new GLTFLoader().register((parser) => new VRMLoaderPlugin(parser));
  loader.setMeshoptDecoder(MeshoptDecoder).setDRACOLoader(globalThis.Worker ? new DRACOLoader() : null);
  loader.register(({ json }) => ({ name: "kouxing", beforeRoot: () => prepareFile(json) }));
  const data = await fetchFile(url);
  const { scene, parser, userData } = await loader.parseAsync(data, THREE.LoaderUtils.extractUrlBase(url));
  const kouxing = scene.getObjectByName("kouxing")?.userData.kouxing;
  scene.updateMatrixWorld(true);
  const meshes = [];
  scene.traverse((node) => {
    node.frustumCulled = false; // its bounds do not follow the face
    if (node.isMesh && node.morphTargetInfluences) meshes.push({ mesh: node, names: targetNames(node, parser) });
  });
  const isHead = kouxing?.faps.some(({ name }) => meshes[0]?.names.includes(name));
  let avatar;
  if (userData.vrm) avatar = vrmAvatar(userData.vrm, meshes);
  else avatar = isHead ? kouxingHead(scene, meshes, kouxing) : morphAvatar(scene, meshes);
  if (!(avatar.view.height > 0 && avatar.view.height < Infinity)) throw new Error("its face has no size; export it again");
  return avatar;
}

/** Return the bytes at a URL. */
export async function fetchFile(url) {
  const answer = await fetch(url).catch(({ message }) => {
    throw new Error(`cannot be loaded (${message}); check the address`);
  });
  if (!answer.ok) throw new Error(`cannot be loaded (${answer.status} ${answer.statusText}); check the address`);
  return answer.arrayBuffer();
}

/**
 * Add a scene with all nodes to a file without scenes. Throw an error if a texture has only an image that needs an
 * extension that cannot be read.
 */
function prepareFile(json) {
  const { scenes = [], nodes = [], textures = [] } = json;
  if (textures.some(({ source, extensions = {} }) => source === undefined && "KHR_texture_basisu" in extensions)) {
    throw new Error(Object.keys(UNREADABLE)[1]);
  }
  if (scenes.length > 0) return;
  const children = new Set(nodes.flatMap((node) => node.children ?? []));
  json.scenes = [{ nodes: [...nodes.keys()].filter((node) => !children.has(node)) }];
}

/** Return the names of a mesh's morph targets, "" for targets without effect. Programs write them in different places. */
function targetNames(mesh, { json, associations }) {
  const { meshes, primitives = 0 } = associations.get(mesh);
  const { targets, extras } = json.meshes[meshes].primitives[primitives];
  const names = [extras, json.meshes[meshes].extras].map((holder) => holder?.targetNames).find(Array.isArray);
  return targets.map(({ POSITION }, i) => (moves(mesh, i) ? String(names?.[i] ?? json.accessors[POSITION]?.name ?? i) : ""));
}

/** Return whether a morph target moves vertices. */
function moves({ geometry }, index) {
  return geometry.morphAttributes.position?.[index]?.array.some((value) => value !== 0) ?? false;
}

function kouxingHead(scene, meshes, { faps, camera }) {
  const morphed = meshes.map(({ mesh }) => new MorphedMesh(mesh, faps));
  const joints = findJoints(scene, faps);
  const [position, target] = [camera.position, camera.target].map((at) => new THREE.Vector3(...at));
  const half = Math.tan(THREE.MathUtils.degToRad(camera.fovYDegrees / 2));
  return {
    scene,
    set: "faps",
    view: { target, height: 2 * half * position.distanceTo(target) },
    pose(values) {
      for (const mesh of morphed) mesh.pose(values);
      rotateJoints(joints, values);
    },
    update() {},
  };
}

function morphAvatar(scene, meshes) {
  const set = chooseSet(meshes.flatMap(({ names }) => names));
  const targets = meshes.flatMap(({ mesh, names }) => {
    const shapes = findShapes(set, names);
    return names.map((name, index) => ({ mesh, index, shape: shapes.get(name) })).filter(({ shape }) => shape);
  });
  const region = new FaceRegion(targets);
  const upright = new THREE.Group().add(scene);
  upright.applyMatrix4(region.upright);
  upright.updateMatrixWorld(true);
  const openJaw = createJawOpener(scene, targets);
  const { center, height } = new FaceRegion(targets).bounds;
  return {
    scene: upright,
    set,
    turnsEyes: targets.some(({ shape }) => shape.startsWith("eyeLook")),
    view: { target: center, height: VIEW_HEIGHT * height },
    pose(weights, names) {
      const weightOf = new Map(names.map((name, i) => [name, weights[i]]));
      for (const { mesh, index, shape } of targets) {
        mesh.morphTargetInfluences[index] = weightOf.get(shape) ?? 0;
      }
      openJaw(Object.entries(OPENINGS).reduce((sum, [shape, opening]) => sum + opening * (weightOf.get(shape) ?? 0), 0));
    },
    update() {},
  };
}

/**
 * Return a function that opens the jaw bone. Its argument is the opening, 0 to 1. The bone moves
 * teeth and tongue; it stays at rest if it also moves a mesh with a shape that opens the mouth.
 */
function createJawOpener(scene, targets) {
  let jaw = null;
  scene.traverse((node) => {
    if (node.isBone && JAW_BONE.test(node.userData.name ?? node.name)) jaw ??= node;
  });
  const skins = targets.filter(({ shape }) => shape in OPENINGS).map(({ mesh }) => mesh);
  if (jaw === null || skins.some((mesh) => isSkinnedBy(mesh, jaw))) return () => {};
  const rest = jaw.quaternion.clone();
  const axis = new THREE.Vector3(1, 0, 0).applyQuaternion(jaw.parent.getWorldQuaternion(new THREE.Quaternion()).invert());
  const turn = new THREE.Quaternion();
  return (opening) => jaw.quaternion.copy(rest).premultiply(turn.setFromAxisAngle(axis, JAW_RADIANS * opening));
}

/** Return whether a bone, or one below it, moves a mesh. */
function isSkinnedBy(mesh, bone) {
  const { skinIndex, skinWeight } = mesh.geometry.attributes;
  if (!mesh.isSkinnedMesh || !skinIndex) return false;
  const bones = new Set();
  bone.traverse((node) => bones.add(node));
  return mesh.skeleton.bones.some(
    (node, joint) => bones.has(node) && skinIndex.array.some((index, i) => index === joint && skinWeight.array[i] > 0),
  );
}

function vrmAvatar(vrm, meshes) {
  VRMUtils.rotateVRM0(vrm); // version 0 faces the other way
  vrm.scene.updateMatrixWorld(true);
  const expressions = (vrm.expressionManager?.expressions ?? []).filter(({ binds }) => binds.some(hasEffect));
  const names = expressions.map(({ expressionName }) => expressionName);
  let speaking = null; // by morph targets, if the expressions do not suffice
  let set;
  try {
    set = chooseSet(names);
  } catch (error) {
    try {
      speaking = morphAvatar(vrm.scene, meshes);
    } catch {
      throw error;
    }
    ({ set } = speaking);
  }
  const shapes = findShapes(set, names);
  const turnsEyes = speaking?.turnsEyes || [...shapes.values()].some((shape) => shape.startsWith("eyeLook"));
  const lookAt = !turnsEyes && vrm.lookAt?.applier instanceof VRMLookAtBoneApplier ? vrm.lookAt : null;
  return {
    scene: vrm.scene,
    set,
    view: speaking?.view ?? viewOfHead(vrm, expressions, shapes),
    pose(weights, shapeNames) {
      speaking?.pose(weights, shapeNames);
      const weightOf = new Map(shapeNames.map((name, i) => [name, weights[i]]));
      for (const [name, shape] of shapes) vrm.expressionManager.setValue(name, weightOf.get(shape) ?? 0);
      if (lookAt) turnEyes(lookAt, weightOf);
    },
    update(seconds) {
      vrm.update(seconds);
    },
  };
}

/** Return the view of the face that expressions move; if they only change materials, above the neck. */
function viewOfHead(vrm, expressions, shapes) {
  const targets = expressions.flatMap(({ expressionName, binds }) => {
    const shape = shapes.get(expressionName);
    const moved = shape === undefined ? [] : binds.filter(({ primitives }) => primitives !== undefined);
    return moved.flatMap(({ primitives, index }) => primitives.map((mesh) => ({ mesh, index, shape })));
  });
  if (targets.length > 0) {
    const { center, height } = new FaceRegion(targets).bounds;
    return { target: center, height: VIEW_HEIGHT * height };
  }
  const head = vrm.humanoid.getRawBoneNode("head");
  const target = head.getWorldPosition(new THREE.Vector3());
  const height = VRM_FACE_M * head.getWorldScale(new THREE.Vector3()).y;
  target.y += height / 4; // the bone is at the end of the neck
  return { target, height: VIEW_HEIGHT * height };
}

/** Return whether a bind of an expression moves vertices or changes a material. */
function hasEffect({ primitives, index }) {
  return primitives === undefined || primitives.some((mesh) => moves(mesh, index));
}

/** Rotate the eyes of a VRM that has eye bones instead of expressions. */
function turnEyes(lookAt, weightOf) {
  const degrees = ([most, shape, ...parts]) =>
    most * (weightOf.get(shape) ?? parts.reduce((sum, part) => sum + (weightOf.get(part) ?? 0) / parts.length, 0));
  lookAt.yaw = degrees(LOOKS.left) - degrees(LOOKS.right);
  lookAt.pitch = degrees(LOOKS.down) - degrees(LOOKS.up);
}
