// A model that a stream of values moves: kouxing's heads by FAPs, other models by blend shapes.

import { VRMLoaderPlugin, VRMUtils } from "@pixiv/three-vrm";
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { findJoints, rotateJoints } from "./page/joints.js";
import { MorphedMesh } from "./page/morph.js";

const VIEW_HEIGHT = 1.6; // of the camera's view, relative to the face
const VRM_FACE_M = 0.24;
const READY_PLAYER_ME = { viseme_i: "ih", viseme_o: "oh", viseme_u: "ou" }; // as in glb_head.py

/**
 * Load a model.
 *
 * @param url of a GLB or VRM file
 * @returns a promise of { scene, set: values that move it ("faps", "arkit", "oculus" or "vrm"),
 *   pose(values, names), update(seconds), view: { target, height } of the face, meters }; it is
 *   rejected if the model has no shapes that can be moved
 */
export async function loadAvatar(url) {
  const loader = new GLTFLoader().register((parser) => new VRMLoaderPlugin(parser));
  const gltf = await loader.loadAsync(url);
  const kouxing = gltf.scene.getObjectByName("kouxing")?.userData.kouxing;
  if (gltf.userData.vrm) return vrmAvatar(gltf.userData.vrm);
  const meshes = [];
  gltf.scene.traverse((node) => {
    if (!node.morphTargetDictionary) return;
    node.frustumCulled = false; // its bounds do not follow the face
    meshes.push(node);
  });
  const target = meshes[0]?.morphTargetDictionary ?? {};
  if (kouxing?.faps.some(({ name }) => name in target)) return kouxingHead(gltf.scene, meshes, kouxing);
  return morphAvatar(gltf.scene, meshes, url);
}

function kouxingHead(scene, meshes, { faps, camera }) {
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
      rotateJoints(joints, values);
    },
    update() {},
  };
}

function morphAvatar(scene, meshes, url) {
  const targets = new Map(); // [mesh, index] of every shape, by its normalized name
  for (const mesh of meshes) {
    for (const [name, index] of Object.entries(mesh.morphTargetDictionary)) {
      const key = normalizedName(name);
      targets.set(key, [...(targets.get(key) ?? []), [mesh, index]]);
    }
  }
  const set = targets.has("jawopen") ? "arkit" : "oculus";
  if (set === "oculus" && !targets.has("aa")) {
    throw new Error(
      `${url}: the model cannot speak; use a VRM, or a GLB with the morph targets of ARKit (jawOpen) ` +
        "or Oculus (viseme_aa)",
    );
  }
  const moving = [...targets].filter(([name]) => name === "jawopen" || name === "aa");
  const box = new THREE.Box3();
  for (const [[mesh]] of moving.map(([, moved]) => moved)) box.expandByObject(mesh);
  return {
    scene,
    set,
    view: { target: box.getCenter(new THREE.Vector3()), height: VIEW_HEIGHT * (box.max.y - box.min.y) },
    pose(weights, names) {
      names.forEach((name, i) => {
        for (const [mesh, index] of targets.get(normalizedName(name)) ?? []) {
          mesh.morphTargetInfluences[index] = weights[i];
        }
      });
    },
    update() {},
  };
}

function vrmAvatar(vrm) {
  VRMUtils.rotateVRM0(vrm); // version 0 faces the other way
  vrm.scene.traverse((node) => (node.frustumCulled = false));
  const expressions = new Map(
    vrm.expressionManager.expressions.map(({ expressionName: name }) => [normalizedName(name), name]),
  );
  const head = vrm.humanoid.getRawBoneNode("head");
  vrm.scene.updateMatrixWorld(true);
  const target = head.getWorldPosition(new THREE.Vector3());
  target.y += VRM_FACE_M / 4; // the bone is at the end of the neck
  return {
    scene: vrm.scene,
    set: expressions.has("jawopen") ? "arkit" : "vrm", // models with "Perfect Sync"
    view: { target, height: VIEW_HEIGHT * VRM_FACE_M },
    pose(weights, names) {
      names.forEach((name, i) => {
        const expression = expressions.get(normalizedName(name));
        if (expression !== undefined) vrm.expressionManager.setValue(expression, weights[i]);
      });
    },
    update(seconds) {
      vrm.update(seconds);
    },
  };
}

/** Return one name for the spellings of programs: mouthSmile_L, Face.mouthSmileLeft, viseme_aa. */
function normalizedName(name) {
  const base = name.replace(/^.*\./, "").replace(/_L$/, "Left").replace(/_R$/, "Right").toLowerCase();
  return READY_PLAYER_ME[base] ?? base.replace(/^viseme_/, "");
}
