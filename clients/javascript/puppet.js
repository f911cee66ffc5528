// A model that a stream of values moves: kouxing's own heads by FAPs, others by blend shapes.

import { VRMLoaderPlugin, VRMUtils } from "@pixiv/three-vrm";
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { findJoints, turnJoints } from "./page/joints.js";
import { MorphedMesh } from "./page/morph.js";

const SPAN = 1.6; // what is seen, by the height of the face
const VRM_FACE_M = 0.24;
const READY_PLAYER_ME = { viseme_i: "ih", viseme_o: "oh", viseme_u: "ou" }; // glb_head.py, too

/**
 * Load a model.
 *
 * @param url of a GLB or VRM
 * @returns a promise of { scene, set: what moves it ("faps", "arkit", "oculus" or "vrm"),
 *   pose(values, names), update(seconds), view: { target, height } of the face, metres }; it fails if
 *   nothing in the model can be moved
 */
export async function loadPuppet(url) {
  const loader = new GLTFLoader().register((parser) => new VRMLoaderPlugin(parser));
  const gltf = await loader.loadAsync(url);
  const own = gltf.scene.getObjectByName("kouxing")?.userData.kouxing;
  if (gltf.userData.vrm) return vrmPuppet(gltf.userData.vrm);
  const meshes = [];
  gltf.scene.traverse((node) => {
    if (!node.morphTargetDictionary) return;
    node.frustumCulled = false; // bounds do not follow the face
    meshes.push(node);
  });
  const target = meshes[0]?.morphTargetDictionary ?? {};
  if (own?.faps.some(({ name }) => name in target)) return ownPuppet(gltf.scene, meshes, own);
  return morphPuppet(gltf.scene, meshes, url);
}

function ownPuppet(scene, meshes, { faps, camera }) {
  const moved = meshes.map((mesh) => new MorphedMesh(mesh, faps));
  const joints = findJoints(scene, faps);
  const [position, target] = [camera.position, camera.target].map((at) => new THREE.Vector3(...at));
  const half = Math.tan(THREE.MathUtils.degToRad(camera.fovYDegrees / 2));
  return {
    scene,
    set: "faps",
    view: { target, height: 2 * half * position.distanceTo(target) },
    pose(values) {
      for (const mesh of moved) mesh.pose(values);
      turnJoints(joints, values);
    },
    update() {},
  };
}

function morphPuppet(scene, meshes, url) {
  const targets = new Map(); // [mesh, index] of each shape, by its plain name
  for (const mesh of meshes) {
    for (const [name, index] of Object.entries(mesh.morphTargetDictionary)) {
      const plain = plainName(name);
      targets.set(plain, [...(targets.get(plain) ?? []), [mesh, index]]);
    }
  }
  const set = targets.has("jawopen") ? "arkit" : "oculus";
  if (set === "oculus" && !targets.has("aa")) {
    throw new Error(`${url}: no morph targets of ARKit (jawOpen) or Oculus (viseme_aa), and no VRM`);
  }
  const moving = [...targets].filter(([name]) => name === "jawopen" || name === "aa");
  const box = new THREE.Box3();
  for (const [[mesh]] of moving.map(([, found]) => found)) box.expandByObject(mesh);
  return {
    scene,
    set,
    view: { target: box.getCenter(new THREE.Vector3()), height: SPAN * (box.max.y - box.min.y) },
    pose(weights, names) {
      names.forEach((name, i) => {
        for (const [mesh, index] of targets.get(plainName(name)) ?? []) {
          mesh.morphTargetInfluences[index] = weights[i];
        }
      });
    },
    update() {},
  };
}

function vrmPuppet(vrm) {
  VRMUtils.rotateVRM0(vrm); // it looks the other way
  vrm.scene.traverse((node) => (node.frustumCulled = false));
  const expressions = new Map(
    vrm.expressionManager.expressions.map(({ expressionName: name }) => [plainName(name), name]),
  );
  const head = vrm.humanoid.getRawBoneNode("head");
  vrm.scene.updateMatrixWorld(true);
  const target = head.getWorldPosition(new THREE.Vector3());
  target.y += VRM_FACE_M / 4; // the bone is where the neck ends
  return {
    scene: vrm.scene,
    set: expressions.has("jawopen") ? "arkit" : "vrm", // "Perfect Sync" has ARKit's
    view: { target, height: SPAN * VRM_FACE_M },
    pose(weights, names) {
      names.forEach((name, i) => {
        const expression = expressions.get(plainName(name));
        if (expression !== undefined) vrm.expressionManager.setValue(expression, weights[i]);
      });
    },
    update(seconds) {
      vrm.update(seconds);
    },
  };
}

/** Return a shape's name as all programs write it: mouthSmile_L, Face.mouthSmileLeft, viseme_aa. */
function plainName(name) {
  const plain = name.replace(/^.*\./, "").replace(/_L$/, "Left").replace(/_R$/, "Right").toLowerCase();
  return READY_PLAYER_ME[plain] ?? plain.replace(/^viseme_/, "");
}
