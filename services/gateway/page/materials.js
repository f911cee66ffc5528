// What the head is drawn with: physical materials where a graphics card is there; the driver's own
// shading (services/driver/render/shaders.py), worked out at the vertices, where the processor
// draws, and for heads drawn as cartoons.

import * as THREE from "three";

const EYES = ["eye_left", "eye_right"];
const HAIR = ["hair", "hair_tips"];
const UNKNOWN = { wrap: [0.3, 0.3, 0.3], gloss: 14, shine: 0.08 }; // of files that do not say
const SOFTWARE = /swiftshader|llvmpipe|softpipe|software|basic render/i;
// half-way to a bright window, in the camera's axes: what eyes mirror
const CATCH_LIGHT = "vec3(-0.187, 0.176, 0.966)";
const MIRROR = `smoothstep(0.988, 0.9935, dot(normal, ${CATCH_LIGHT}))`;

/** Say whether the processor draws, and not a graphics card. */
export function drawsInSoftware(gl) {
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  return SOFTWARE.test(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
}

const PLAIN_VERTEX = `
uniform vec3 wrap;
uniform float gloss;
uniform float shine;
uniform float share;
varying vec2 vUv;
varying vec3 vLight;
varying float vHigh;
varying vec3 vNormal;
#ifdef USE_SKINNING
  uniform mat4 turn;
#endif

const vec3 KEY = vec3(-0.4067, 0.4842, 0.7747);
const vec3 FILL = vec3(0.7767, 0.1036, 0.6213);
const vec3 RIM = vec3(0.5518, 0.4515, -0.7023);

void main() {
  vec3 turned = position;
  vec3 n = normal;
  #ifdef USE_SKINNING // the neck follows the head by a share, and the shoulders do not
    turned = mix(position, (turn * vec4(position, 1.0)).xyz, skinWeight.y);
    n = mix(normal, mat3(turn) * normal, skinWeight.y);
  #endif
  vec4 place = modelMatrix * vec4(turned, 1.0);
  n = normalize(mat3(modelMatrix) * n);
  vec3 v = normalize(cameraPosition - place.xyz);
  float facing = dot(n, v);
  #ifdef TWO_SIDED
    if (facing < 0.0) { n = -n; facing = -facing; }
  #endif
  float key = dot(n, KEY);
  vLight = mix(vec3(0.25, 0.21, 0.19), vec3(0.42, 0.44, 0.48), 0.5 + 0.5 * n.y)
    + vec3(1.16, 1.06, 0.96) * max((key + wrap) / (1.0 + wrap), 0.0) / (1.0 + wrap)
    + vec3(0.34, 0.38, 0.44) * max(dot(n, FILL) * 0.7 + 0.3, 0.0)
    + vec3(0.45, 0.47, 0.50) * max(dot(n, RIM), 0.0);
  vLight *= share * color.rgb;
  float grazing = 1.0 - max(facing, 0.0);
  float fresnel = 0.04 + 0.5 * grazing * grazing * grazing * grazing;
  vHigh = pow(max(dot(n, normalize(KEY + v)), 0.0), gloss) * max(key, 0.0) * (0.6 + fresnel);
  vHigh = (vHigh + fresnel * 0.10) * shine * share * min(1.0, color.g * 1.6);
  vNormal = mat3(viewMatrix) * n;
  vUv = uv;
  gl_Position = projectionMatrix * viewMatrix * place;
}`;

const PLAIN_FRAGMENT = `
uniform sampler2D map;
varying vec2 vUv;
varying vec3 vLight;
varying float vHigh;
varying vec3 vNormal;

void main() {
  vec4 texel = texture2D(map, vUv);
  texel.rgb *= texel.rgb; // close to sRGB, as the root below
  vec3 lit = vLight;
  float high = vHigh;
  #ifdef CEL
    float strength = dot(lit, vec3(0.333));
    lit *= mix(0.70, 0.96, smoothstep(0.60, 0.66, strength)) / max(strength, 0.25);
    high = 0.0;
  #endif
  #ifdef EYE
    vec3 normal = normalize(vNormal);
    high += ${MIRROR};
  #endif
  gl_FragColor = vec4(sqrt(min(texel.rgb * lit + high, 1.0)), texel.a);
}`;

/**
 * The driver's shading for a part; `gltf` is its material in the file, `head` the node that the skin
 * turns with. Textures are read as cheaply as the processor can.
 */
export function plainMaterial(name, gltf, head, cel) {
  gltf.map.colorSpace = THREE.NoColorSpace;
  gltf.map.minFilter = THREE.LinearMipmapNearestFilter;
  const { wrap, gloss, shine } = gltf.userData.kouxing ?? UNKNOWN;
  const defines = {};
  if (cel && !EYES.includes(name)) defines.CEL = 1;
  if (EYES.includes(name)) defines.EYE = 1;
  if (gltf.side === THREE.DoubleSide) defines.TWO_SIDED = 1;
  return new THREE.ShaderMaterial({
    defines,
    uniforms: {
      map: { value: gltf.map },
      wrap: { value: new THREE.Vector3(...wrap) },
      gloss: { value: gloss },
      shine: { value: shine },
      share: { value: 1 },
      turn: { value: head.matrixWorld },
    },
    vertexShader: PLAIN_VERTEX,
    fragmentShader: PLAIN_FRAGMENT,
    vertexColors: true,
    ...surface(gltf),
  });
}

/** A physical material for a part: light that scatters under the skin, wet eyes, silky hair. */
export function physicalMaterial(name, gltf) {
  const { wrap } = gltf.userData.kouxing ?? UNKNOWN;
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
    Object.assign(material, { specularIntensity: 0.35, roughness: 0.5 });
  } else if (EYES.includes(name)) {
    Object.assign(material, { clearcoat: 1, clearcoatRoughness: 0.03 });
  }
  material.onBeforeCompile = (shader) => {
    shader.uniforms.wrap = { value: new THREE.Vector3(...wrap) };
    shader.fragmentShader =
      "uniform vec3 wrap;\n" +
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
          EYES.includes(name)
            ? `totalEmissiveRadiance += ${MIRROR};`
            : `float open = min(1.0, 1.6 * vColor.g * diffuse.g);
               reflectedLight.directSpecular *= open;
               reflectedLight.indirectSpecular *= open;`,
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
