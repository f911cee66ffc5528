// Lighting of a head. The driver's shaders include this file (services/driver/render/shaders.py), and
// so do the page's simple materials (services/gateway/page/materials.js).
//
// Colors are linear. The lights are a sky and a ground, a warm key light from the front upper left, a
// cool fill light and a rim light. Skin wraps the key light around the terminator, red farthest, like
// light that is scattered under the skin. Highlights follow Blinn and Phong, and Kajiya and Kay for
// hair, with Schlick's Fresnel factor.

uniform vec3 wrap; // wrap of the key light, by channel
uniform float gloss; // exponent of the highlight
uniform float shine; // strength of the highlight
uniform float share; // share of the light that enters the mouth
uniform bool two_sided;
uniform bool strands; // hair, down from the crown
uniform bool cel; // one light and one dark tone, no highlights

const vec3 KEY = vec3(-0.4067, 0.4842, 0.7747);
const vec3 FILL = vec3(0.7767, 0.1036, 0.6213);
const vec3 RIM = vec3(0.5518, 0.4515, -0.7023);
const vec3 KEY_COLOR = vec3(1.42, 1.28, 1.14);
const vec3 FILL_COLOR = vec3(0.22, 0.25, 0.30);
const vec3 RIM_COLOR = vec3(0.75, 0.78, 0.84);
const vec3 SKY = vec3(0.36, 0.38, 0.42);
const vec3 GROUND = vec3(0.17, 0.14, 0.125);
const float SHOULDER = 0.22; // how much bright light is compressed, so that it does not clip
const float GLOSS = 14.0; // of a color per difference of red and green
const float STRANDS = 1.8; // of a hair texture's squared gray; its mean reflects fully
const vec3 CROWN = vec3(0.0, 0.97, -0.24);
// reflections in the eyes; lower than the key light, because the lid would hide them
const vec3 WINDOW = vec3(-0.36, 0.34, 0.87);
const vec3 FLOOR = vec3(0.50, -0.46, 0.82);

// Light on a vertex with the normal n, seen from the direction v: scattered by the texture (tint: color
// and baked occlusion) and reflected.
void light_vertex(vec3 n, vec3 v, vec3 tint, out vec3 light, out float high) {
  float facing = dot(n, v);
  if (two_sided && facing < 0.0) {
    n = -n;
    facing = -facing;
  }
  float key = dot(n, KEY);
  light = mix(GROUND, SKY, 0.5 + 0.5 * n.y)
    + KEY_COLOR * max((key + wrap) / (1.0 + wrap), 0.0) / (1.0 + wrap)
    + FILL_COLOR * max(dot(n, FILL) * 0.7 + 0.3, 0.0)
    + RIM_COLOR * max(dot(n, RIM), 0.0);
  light *= share * tint / (1.0 + SHOULDER * light.g);
  vec3 half_way = normalize(KEY + v);
  float mirrored = max(dot(n, half_way), 0.0);
  float open = min(1.0, tint.g * 1.6); // parts in shadow reflect less
  if (strands) { // darker strands have higher highlights
    vec3 strand = normalize(n * (dot(n, CROWN) - 0.6 + 0.3 * tint.g) - CROWN);
    float along = dot(strand, half_way);
    mirrored = sqrt(max(1.0 - along * along, 0.0));
    open = sqrt(tint.g); // dark strands are as smooth as fair ones
  }
  float grazing = 1.0 - max(facing, 0.0);
  float fresnel = 0.04 + 0.5 * grazing * grazing * grazing * grazing;
  high = pow(mirrored, gloss) * max(key, 0.0) * (0.6 + fresnel);
  high = (high + fresnel * 0.10) * shine * share * open;
}

// Color of a texel. Texel and result are sRGB; squares approximate linear light at low cost.
vec3 shaded(vec3 texel, vec3 light, float high) {
  if (cel) {
    float strength = dot(light, vec3(0.333));
    light *= mix(0.70, 0.96, smoothstep(0.60, 0.66, strength)) / max(strength, 0.25);
    high = 0.0;
  }
  high *= strands ? STRANDS * texel.g * texel.g : 1.0 + GLOSS * max(texel.r - texel.g - 0.23, 0.0); // lips are wet
  return sqrt(min(texel * texel * light + high, 1.0));
}

// Reflection in an eye with the normal n: a sharp bright window and a soft ground; `ahead` points from
// the head to the camera.
float mirrored(vec3 n, vec3 ahead) {
  float window = smoothstep(0.9915, 0.9945, dot(n, normalize(WINDOW + ahead)));
  return window + 0.05 * smoothstep(0.980, 0.992, dot(n, normalize(FLOOR + ahead)));
}
