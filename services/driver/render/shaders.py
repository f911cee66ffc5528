"""The GLSL shaders and the materials of a head; the lighting is in ``light.glsl``."""

from pathlib import Path

import kouxing.shared.face

LIGHT = Path(kouxing.shared.face.__file__).with_name("light.glsl").read_text(encoding="utf-8")

# Lighting is computed at the vertices, about 1 mm apart, and interpolated. In software GL this
# takes a third of the time of lighting every pixel. Only the small highlights of the eyes are lit
# per pixel.
VERTEX = f"""
#version 330
{LIGHT}
uniform mat4 view_projection;
uniform vec3 eye;
in vec3 in_position;
in vec3 in_normal;
in vec2 in_uv;
in vec3 in_color;
out vec2 uv;
out vec3 light;
out float high;
out vec3 normal;

void main() {{
    light_vertex(in_normal, normalize(eye - in_position), in_color, light, high);
    uv = in_uv;
    normal = in_normal;
    gl_Position = view_projection * vec4(in_position, 1.0);
}}
"""

FRAGMENT = f"""
#version 330
{LIGHT}
uniform sampler2D base;
in vec2 uv;
in vec3 light;
in float high;
out vec4 color;
void main() {{
    vec4 texel = texture(base, uv);
    color = vec4(shaded(texel.rgb, light, high), texel.a);
}}
"""

# Texels with little alpha are omitted, because they would hide what is drawn behind them later.
CUTOUT_FRAGMENT = FRAGMENT.replace(
    "color = vec4", "if (texel.a < cutoff) discard;\n    color = vec4"
).replace("uniform sampler2D", "uniform float cutoff;\nuniform sampler2D")

EYE_FRAGMENT = f"""
#version 330
{LIGHT}
uniform sampler2D base;
uniform vec3 eye;
in vec2 uv;
in vec3 light;
in vec3 normal;
out vec4 color;
void main() {{
    vec3 texel = texture(base, uv).rgb;
    color = vec4(shaded(texel, light, mirrored(normalize(normal), normalize(eye))), 1.0);
}}
"""

BACKDROP = """
#version 330
uniform vec3 center;
uniform vec3 edge;
in vec2 place;
out vec4 color;
void main() {
    color = vec4(mix(center, edge, min(1.0, dot(place, place) * 0.55)), 1.0);
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

EYE_PARTS = ("eye_left", "eye_right")
MOUTH_PARTS = ("teeth_upper", "teeth_lower", "tongue")  # receives light through the lips
HAIR_PART = "hair"  # vertical strands
HAIR_CUTOFF, CUTOFF = 0.30, 0.02  # texels with less alpha are not drawn, in hair and elsewhere

# part: (wrap of the key light by channel, gloss exponent, strength of the highlight)
MATERIALS: dict[str, tuple[tuple[float, float, float], float, float]] = {
    "skin": ((0.46, 0.30, 0.25), 20.0, 0.26),
    "garment": ((0.25, 0.25, 0.25), 8.0, 0.05),
    "eye_left": ((0.4, 0.36, 0.36), 8.0, 0.0),
    "eye_right": ((0.4, 0.36, 0.36), 8.0, 0.0),
    "tears": ((0.8, 0.8, 0.8), 10.0, 1.2),
    "teeth_upper": ((0.4, 0.38, 0.36), 30.0, 1.0),
    "teeth_lower": ((0.4, 0.38, 0.36), 30.0, 1.0),
    "tongue": ((0.5, 0.3, 0.3), 14.0, 2.0),
    "hair": ((0.3, 0.3, 0.3), 50.0, 0.55),
    "brows": ((0.5, 0.34, 0.29), 8.0, 0.0),
    "lashes": ((0.0, 0.0, 0.0), 8.0, 0.0),
}
PLAIN_MATERIAL = ((0.3, 0.3, 0.3), 14.0, 0.08)  # other parts
