"""The shaders (GLSL) and the materials that they draw.

Lighting (linear colours): a sky-and-ground ambient term (scaled by the baked occlusion in the
vertex colours), a warm key light from the front upper left, a cool fill light and a rim light;
skin wraps the key light round the terminator, red farthest, as light scattered under it does.
The highlights follow Blinn-Phong with Schlick's Fresnel factor.
"""

from __future__ import annotations

import numpy as np

# Light is worked out at the vertices (they lie about 1 mm apart) and interpolated: on software GL
# that takes a third of the time of lighting every pixel. Only the eyes' small highlights need it.
VERTEX = """
#version 330
uniform mat4 view_projection;
uniform vec3 eye;
uniform vec3 wrap;
uniform float gloss;
uniform float shine;
uniform float two_sided;
uniform float share;
in vec3 in_position;
in vec3 in_normal;
in vec2 in_uv;
in vec3 in_color;
out vec2 uv;
out vec3 light;
out float high;
out vec3 normal;

const vec3 KEY = normalize(vec3(-0.42, 0.50, 0.80));
const vec3 FILL = normalize(vec3(0.75, 0.10, 0.60));
const vec3 RIM = normalize(vec3(0.55, 0.45, -0.70));
const vec3 KEY_COLOR = vec3(1.16, 1.06, 0.96);
const vec3 FILL_COLOR = vec3(0.34, 0.38, 0.44);
const vec3 RIM_COLOR = vec3(0.45, 0.47, 0.50);
const vec3 SKY = vec3(0.42, 0.44, 0.48);
const vec3 GROUND = vec3(0.25, 0.21, 0.19);

void main() {
    vec3 n = in_normal;
    vec3 v = normalize(eye - in_position);
    float facing = dot(n, v);
    if (two_sided > 0.0 && facing < 0.0) { n = -n; facing = -facing; }
    float key = dot(n, KEY);
    light = mix(GROUND, SKY, 0.5 + 0.5 * n.y)
        + KEY_COLOR * max((key + wrap) / (1.0 + wrap), 0.0) / (1.0 + wrap)
        + FILL_COLOR * max(dot(n, FILL) * 0.7 + 0.3, 0.0)
        + RIM_COLOR * max(dot(n, RIM), 0.0);
    light *= share * in_color;
    float grazing = 1.0 - max(facing, 0.0);
    float fresnel = 0.04 + 0.5 * grazing * grazing * grazing * grazing;
    high = pow(max(dot(n, normalize(KEY + v)), 0.0), gloss) * max(key, 0.0) * (0.6 + fresnel);
    high = (high + fresnel * 0.10) * shine * share * min(1.0, in_color.g * 1.6);
    uv = in_uv;
    normal = in_normal;
    gl_Position = view_projection * vec4(in_position, 1.0);
}
"""

# textures and pictures are taken as squared for linear light: close to sRGB, and cheap
FRAGMENT = """
#version 330
uniform sampler2D base;
uniform float cel;
in vec2 uv;
in vec3 light;
in float high;
out vec4 color;
void main() {
    vec4 texel = texture(base, uv);
    vec3 lit = light;
    if (cel > 0.0) {
        float strength = dot(light, vec3(0.333));
        lit *= mix(0.70, 0.96, smoothstep(0.60, 0.66, strength)) / max(strength, 0.25);
    }
    color = vec4(sqrt(texel.rgb * texel.rgb * lit + high * (1.0 - cel)), texel.a);
}
"""

# An eye mirrors a bright window, sharply, and the ground, softly.
EYE_FRAGMENT = """
#version 330
uniform sampler2D base;
uniform vec3 half_way;
uniform vec3 half_way_low;
in vec2 uv;
in vec3 light;
in vec3 normal;
out vec4 color;
void main() {
    vec3 texel = texture(base, uv).rgb;
    vec3 n = normalize(normal);
    float high = smoothstep(0.988, 0.9935, dot(n, half_way));
    high += 0.05 * smoothstep(0.980, 0.992, dot(n, half_way_low));
    color = vec4(sqrt(min(texel * texel * light + high, 1.0)), 1.0);
}
"""

BACKDROP = """
#version 330
uniform vec3 middle;
uniform vec3 edge;
in vec2 place;
out vec4 color;
void main() {
    color = vec4(mix(middle, edge, min(1.0, dot(place, place) * 0.55)), 1.0);
}
"""

BACKDROP_VERTEX = """
#version 330
in vec2 corner;
out vec2 place;
void main() {
    place = corner - vec2(0.0, 0.25);
    gl_Position = vec4(corner, 0.99999, 1.0);
}
"""

EYES = ("eye_left", "eye_right")
IN_MOUTH = ("teeth_upper", "teeth_lower", "tongue")  # lit through the lips
# what eyes mirror: lower than the key light, or the lid would hide it
WINDOW = np.array([-0.36, 0.34, 0.87])
FLOOR = np.array([0.50, -0.46, 0.82])

# part: (wrap of the key light by channel, gloss exponent, strength of the highlight)
MATERIALS: dict[str, tuple[tuple[float, float, float], float, float]] = {
    "skin": ((0.50, 0.34, 0.29), 22.0, 0.16),
    "garment": ((0.25, 0.25, 0.25), 8.0, 0.05),
    "eye_left": ((0.4, 0.36, 0.36), 8.0, 0.0),
    "eye_right": ((0.4, 0.36, 0.36), 8.0, 0.0),
    "teeth_upper": ((0.4, 0.38, 0.36), 30.0, 1.2),
    "teeth_lower": ((0.4, 0.38, 0.36), 30.0, 1.2),
    "tongue": ((0.5, 0.3, 0.3), 14.0, 2.0),
    "hair": ((0.3, 0.3, 0.3), 18.0, 0.16),
    "hair_tips": ((0.3, 0.3, 0.3), 18.0, 0.16),
    "lashes": ((0.0, 0.0, 0.0), 8.0, 0.0),
}
PLAIN = ((0.3, 0.3, 0.3), 14.0, 0.08)  # parts with no material known here
