// What the head is drawn with: physical materials where a graphics card is there; the driver's own
// shading (shared/face/light.glsl), worked out at the vertices, where the processor draws, and for
// heads drawn as cartoons.

import * as THREE from "three";

const EYES = ["eye_left", "eye_right"];
const HAIR = ["hair", "hair_tips"];
const UNKNOWN = { wrap: [0.3, 0.3, 0.3], gloss: 14, shine: 0.08 }; // of files that do not say
const LIGHT = await (await fetch("light.glsl")).text(); // GLSL, the driver's, too

const PLAIN_VERTEX = `
${LIGHT}
varying vec2 vUv;
varying vec3 vLight;
varying float vHigh;
varying vec3 vFacing;
#ifdef USE_SKINNING
  uniform mat4 turn;
#endif

void main() {
  vec3 turned = position;
  vec3 n = normal;
  #ifdef USE_SKINNING // the neck follows the head by a share, and the shoulders do not
    turned = mix(position, (turn * vec4(position, 1.0)).xyz, skinWeight.y);
    n = mix(normal, mat3(turn) * normal, skinWeight.y);
  #endif
  vec4 place = modelMatrix * vec4(turned, 1.0);
  vFacing = normalize(mat3(modelMatrix) * n);
  light_vertex(vFacing, normalize(cameraPosition - place.xyz), color.rgb, vLight, vHigh);
  vUv = uv;
  gl_Position = projectionMatrix * viewMatrix * place;
}`;

const PLAIN_FRAGMENT = `
${LIGHT}
uniform sampler2D map;
varying vec2 vUv;
varying vec3 vLight;
varying float vHigh;
varying vec3 vFacing;

void main() {
  vec4 texel = texture2D(map, vUv);
  #ifdef EYE
    float high = mirrored(normalize(vFacing), normalize(cameraPosition));
  #else
    float high = vHigh;
  #endif
  gl_FragColor = vec4(shaded(texel.rgb, vLight, high), texel.a);
}`;

/** The uniforms of light.glsl. */
function lightUniforms(name, gltf, cel) {
  const { wrap, gloss, shine } = gltf.userData.kouxing ?? UNKNOWN;
  return {
    wrap: { value: new THREE.Vector3(...wrap) },
    gloss: { value: gloss },
    shine: { value: shine },
    share: { value: 1 },
    two_sided: { value: gltf.side === THREE.DoubleSide },
    strands: { value: HAIR.includes(name) },
    cel: { value: cel },
  };
}

/**
 * The driver's shading for a part; `gltf` is its material in the file, `head` the node that the skin
 * turns with. Textures are read as cheaply as the processor can.
 */
export function plainMaterial(name, gltf, head, cel) {
  gltf.map.colorSpace = THREE.NoColorSpace;
  gltf.map.minFilter = THREE.LinearMipmapNearestFilter;
  const isEye = EYES.includes(name);
  return new THREE.ShaderMaterial({
    defines: isEye ? { EYE: 1 } : {},
    uniforms: {
      map: { value: gltf.map },
      turn: { value: head.matrixWorld },
      ...lightUniforms(name, gltf, cel && !isEye),
    },
    vertexShader: PLAIN_VERTEX,
    fragmentShader: PLAIN_FRAGMENT,
    vertexColors: true,
    ...surface(gltf),
  });
}

// what physical parts mirror as the plain ones do
const WINDOW = `totalEmissiveRadiance += mirrored(
  inverseTransformDirection(normal, viewMatrix), normalize(cameraPosition));`;
const SHEEN = `vec3 light;
  float high;
  light_vertex(inverseTransformDirection(normal, viewMatrix),
    inverseTransformDirection(normalize(vViewPosition), viewMatrix), vColor.rgb, light, high);
  totalEmissiveRadiance += high;`;
const ADDED = { eye_left: WINDOW, eye_right: WINDOW, hair: SHEEN, hair_tips: SHEEN };

/** A physical material for a part: light that scatters under the skin, wet eyes, silky hair. */
export function physicalMaterial(name, gltf) {
  const material = new THREE.MeshPhysicalMaterial({
    map: gltf.map,
    vertexColors: true,
    roughness: gltf.roughness,
    metalness: 0,
    ...surface(gltf),
  });
  if (name === "skin") {
    Object.assign(material, { sheen: 0.25, sheenRoughness: 0.5, specularIntensity: 0.6 });
    material.sheenColor.set(0xffc8b0);
  } else if (HAIR.includes(name)) {
    Object.assign(material, { specularIntensity: 0.2, roughness: 0.6 });
  } else if (EYES.includes(name)) {
    Object.assign(material, { clearcoat: 0.3, clearcoatRoughness: 0.03, specularIntensity: 0.3 });
  }
  material.onBeforeCompile = (shader) => {
    Object.assign(shader.uniforms, lightUniforms(name, gltf, false));
    shader.fragmentShader =
      LIGHT +
      shader.fragmentShader
        .replace(
          "#include <lights_physical_pars_fragment>",
          // light goes round the terminator, red farthest
          THREE.ShaderChunk.lights_physical_pars_fragment.replace(
            "reflectedLight.directDiffuse += irradiance",
            "vec3 round = (dot(geometryNormal, directLight.direction) + wrap) / (1.0 + wrap);\n" +
              "reflectedLight.directDiffuse += " +
              "max(round, 0.0) / (1.0 + wrap) * directLight.color",
          ),
        )
        .replace(
          "#include <aomap_fragment>",
          // what lies in shadow, by its baked vertex colours, shines less, too
          `float open = min(1.0, 1.6 * vColor.g * diffuse.g);
          reflectedLight.directSpecular *= open;
          reflectedLight.indirectSpecular *= open;
          ${ADDED[name] ?? ""}`,
        );
  };
  return material;
}

/** Let a part in the mouth have so much of the light, 0 to 1. */
export function dim(material, share) {
  if (material.uniforms) material.uniforms.share.value = share;
  else material.color.setScalar(share);
}

/** Give back the memory of a material and its texture. */
export function release(material) {
  (material.map ?? material.uniforms?.map.value)?.dispose();
  material.dispose();
}

/** A studio about the head, as an environment map: soft boxes before dim walls. */
export function studio(renderer) {
  const room = new THREE.Scene();
  const box = (color, width, height, x, y, z) => {
    const light = new THREE.Mesh(
      new THREE.PlaneGeometry(width, height),
      new THREE.MeshBasicMaterial({ color: new THREE.Color(color, color, color) }),
    );
    light.position.set(x, y, z);
    light.lookAt(0, 0, 0);
    room.add(light);
  };
  room.background = new THREE.Color(0.32, 0.32, 0.34);
  box(6, 2.2, 2.2, -2.2, 2.4, 3.4);
  box(2.5, 1.6, 3, 4, 0.6, 2.2);
  box(2, 5, 2, 0, 4.5, -1);
  box(0.12, 10, 10, 0, -4, 0);
  const generator = new THREE.PMREMGenerator(renderer);
  const { texture } = generator.fromScene(room, 0.03);
  generator.dispose();
  return texture;
}

function surface({ side, transparent, depthWrite }) {
  return { side, transparent, depthWrite };
}
