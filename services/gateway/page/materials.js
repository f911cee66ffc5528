// The head's materials. With a graphics card they are physical. Without one, and for cartoon heads,
// the driver's shading (shared/face/light.glsl) is computed at the vertices.

import * as THREE from "three";

const EYES = ["eye_left", "eye_right"];
const HAIR = "hair";
const HAIR_CUTOFF = 0.3; // texels with less alpha are not drawn, as in the driver
const DEFAULT_SHADING = { wrap: [0.3, 0.3, 0.3], gloss: 14, shine: 0.08 }; // used for files without these values

let lightShader = null; // source code that is shared with the driver; null before loadLight()

/** Load the source code of the light, which all materials need. */
export async function loadLight() {
  if (lightShader !== null) return;
  const response = await fetch("light.glsl");
  if (!response.ok) throw new Error(`light.glsl: ${response.status} ${response.statusText}`);
  lightShader = await response.text();
}

const PLAIN_VERTEX = `
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
  #ifdef USE_SKINNING // the neck follows the head partly, the shoulders do not
    turned = mix(position, (turn * vec4(position, 1.0)).xyz, skinWeight.y);
    n = mix(normal, mat3(turn) * normal, skinWeight.y);
  #endif
  vec4 world = modelMatrix * vec4(turned, 1.0);
  vFacing = normalize(mat3(modelMatrix) * n);
  light_vertex(vFacing, normalize(cameraPosition - world.xyz), color.rgb, vLight, vHigh);
  vUv = uv;
  gl_Position = projectionMatrix * viewMatrix * world;
}`;

const PLAIN_FRAGMENT = `
uniform sampler2D map;
varying vec2 vUv;
varying vec3 vLight;
varying float vHigh;
varying vec3 vFacing;

void main() {
  vec4 texel = texture2D(map, vUv);
  #ifdef HAIR
    if (texel.a < HAIR) discard;
  #endif
  #ifdef EYE
    float high = mirrored(normalize(vFacing), normalize(cameraPosition));
  #else
    float high = vHigh;
  #endif
  gl_FragColor = vec4(shaded(texel.rgb, vLight, high), texel.a);
}`;

/** The uniforms of light.glsl. */
function lightUniforms(name, gltf, cel) {
  const { wrap, gloss, shine } = gltf.userData.kouxing ?? DEFAULT_SHADING;
  return {
    wrap: { value: new THREE.Vector3(...wrap) },
    gloss: { value: gloss },
    shine: { value: shine },
    share: { value: 1 },
    two_sided: { value: gltf.side === THREE.DoubleSide },
    strands: { value: name === HAIR },
    cel: { value: cel },
  };
}

/** Return the driver's shading for a part. Its skin follows the rotation of the node `head`. */
export function plainMaterial(name, gltf, head, cel) {
  gltf.map.colorSpace = THREE.NoColorSpace;
  gltf.map.minFilter = THREE.LinearMipmapNearestFilter;
  const isEye = EYES.includes(name);
  return new THREE.ShaderMaterial({
    defines: isEye ? { EYE: 1 } : name === HAIR ? { HAIR: HAIR_CUTOFF } : {},
    uniforms: {
      map: { value: gltf.map },
      turn: { value: head.matrixWorld },
      ...lightUniforms(name, gltf, cel && !isEye),
    },
    vertexShader: lightShader + PLAIN_VERTEX,
    fragmentShader: lightShader + PLAIN_FRAGMENT,
    vertexColors: true,
    ...blending(name, gltf),
  });
}

// Reflections that the plain materials also have.
const WINDOW = `totalEmissiveRadiance += mirrored(
  inverseTransformDirection(normal, viewMatrix), normalize(cameraPosition));`;
const SHEEN = `vec3 light;
  float high;
  light_vertex(inverseTransformDirection(normal, viewMatrix),
    inverseTransformDirection(normalize(vViewPosition), viewMatrix), vColor.rgb, light, high);
  totalEmissiveRadiance += high * STRANDS * sampledDiffuseColor.g;`;
const REFLECTIONS = { eye_left: WINDOW, eye_right: WINDOW, hair: SHEEN };

/** Return a physical material for a part: subsurface scattering, wet eyes, glossy hair. */
export function physicalMaterial(name, gltf) {
  const material = new THREE.MeshPhysicalMaterial({
    map: gltf.map,
    vertexColors: true,
    roughness: gltf.roughness,
    metalness: 0,
    normalMap: gltf.normalMap,
    alphaTest: name === HAIR ? HAIR_CUTOFF : 0,
    ...blending(name, gltf),
  });
  if (name === "skin") {
    Object.assign(material, { sheen: 0.25, sheenRoughness: 0.5, specularIntensity: 0.6 });
    material.sheenColor.set(0xffc8b0);
  } else if (name === HAIR) {
    Object.assign(material, { specularIntensity: 0.2, roughness: 0.6 });
  } else if (EYES.includes(name)) {
    Object.assign(material, { clearcoat: 0.3, clearcoatRoughness: 0.03, specularIntensity: 0.3 });
  }
  material.onBeforeCompile = (shader) => {
    Object.assign(shader.uniforms, lightUniforms(name, gltf, false));
    shader.fragmentShader =
      lightShader +
      shader.fragmentShader
        .replace(
          "#include <lights_physical_pars_fragment>",
          // subsurface scattering: light reaches beyond the terminator, red farthest
          THREE.ShaderChunk.lights_physical_pars_fragment.replace(
            "reflectedLight.directDiffuse += irradiance",
            "vec3 round = (dot(geometryNormal, directLight.direction) + wrap) / (1.0 + wrap);\n" +
              "reflectedLight.directDiffuse += " +
              "max(round, 0.0) / (1.0 + wrap) * directLight.color",
          ),
        )
        .replace(
          "#include <aomap_fragment>",
          // shadows are baked into the vertex colors; parts in shadow also reflect less
          `float open = min(1.0, 1.6 * vColor.g * diffuse.g);
          reflectedLight.directSpecular *= open;
          reflectedLight.indirectSpecular *= open;
          ${REFLECTIONS[name] ?? ""}`,
        );
  };
  return material;
}

/** Set the light on a part inside the mouth, 0 to 1. */
export function setLight(material, share) {
  if (material.uniforms) material.uniforms.share.value = share;
  else material.color.setScalar(share);
}

/** Free the memory of a material and its texture. */
export function release(material) {
  (material.map ?? material.uniforms?.map.value)?.dispose();
  material.normalMap?.dispose();
  material.dispose();
}

/** Return the environment map of a studio: soft boxes in front of dim walls. */
export function studioEnvironment(renderer) {
  const room = new THREE.Scene();
  const addSoftBox = (color, width, height, x, y, z) => {
    const light = new THREE.Mesh(
      new THREE.PlaneGeometry(width, height),
      new THREE.MeshBasicMaterial({ color: new THREE.Color(color, color, color) }),
    );
    light.position.set(x, y, z);
    light.lookAt(0, 0, 0);
    room.add(light);
  };
  room.background = new THREE.Color(0.32, 0.32, 0.34);
  addSoftBox(6, 2.2, 2.2, -2.2, 2.4, 3.4);
  addSoftBox(2.5, 1.6, 3, 4, 0.6, 2.2);
  addSoftBox(2, 5, 2, 0, 4.5, -1);
  addSoftBox(0.12, 10, 10, 0, -4, 0);
  const generator = new THREE.PMREMGenerator(renderer);
  const { texture } = generator.fromScene(room, 0.03);
  generator.dispose();
  return texture;
}

/** Hair has soft edges and hides parts behind it. Its triangles are stored in blending order. */
function blending(name, { side, transparent, depthWrite }) {
  return { side, transparent: transparent || name === HAIR, depthWrite };
}
