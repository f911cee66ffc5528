"""Draw a head with OpenGL, without a display (EGL) or into a window that is already there.

Lighting (linear colours): a sky-and-ground ambient term (scaled by the baked occlusion in the
vertex colours), a warm key light from the front upper left, a cool fill light and a rim light;
skin wraps the key light round the terminator, red farthest, as light scattered under it does.
The highlights follow Blinn-Phong with Schlick's Fresnel factor.
"""

from __future__ import annotations

import ctypes.util
import time
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np
from numpy.typing import NDArray

from services.driver import picture
from services.driver.head import Head, Part
from shared.errors import UserError

UInt8 = NDArray[np.uint8]
Float32 = NDArray[np.float32]

Background = tuple[tuple[float, ...], tuple[float, ...]] | None  # sRGB, middle and edge

DEBIAN_PACKAGES = "libegl1 libgl1 libgl1-mesa-dri"


_LEAST_ASPECT = 0.7  # narrower pictures show more above and below, so that the face still fits


@dataclass(frozen=True, slots=True)
class Camera:
    """Where a head is seen from; lengths in m, in the head's axes."""

    position: tuple[float, float, float] = (0.0, 0.030, 1.05)
    target: tuple[float, float, float] = (0.0, 0.018, 0.0)
    field_of_view_deg: float = 15.0  # vertical

    def view_projection(self, width_px: int, height_px: int) -> Float32:
        """Make the matrix (4, 4) from the head's axes to the picture's."""
        eye = np.array(self.position)
        ahead = np.array(self.target) - eye
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(right, ahead), -ahead])
        view = np.eye(4)
        view[:3, :3], view[:3, 3] = axes, -axes @ eye
        near, far = 0.1, 5.0
        scale = 1.0 / np.tan(np.radians(self.field_of_view_deg) / 2)
        scale *= min(1.0, width_px / height_px / _LEAST_ASPECT)
        projection = np.zeros((4, 4))
        projection[0, 0], projection[1, 1] = scale * height_px / width_px, scale
        projection[2, 2:] = (far + near) / (near - far), 2 * far * near / (near - far)
        projection[3, 2] = -1.0
        return np.asarray(projection @ view, dtype=np.float32)


BACKGROUND = ((0.62, 0.69, 0.75), (0.36, 0.43, 0.50))  # sRGB, middle and edge

# Light is worked out at the vertices (they lie about 1 mm apart) and interpolated: on software GL
# that takes a third of the time of lighting every pixel. Only the eyes' small highlights need it.
_VERTEX = """
#version 330
uniform mat4 view_projection;
uniform vec3 eye;
uniform vec3 wrap;
uniform float gloss;
uniform float shine;
uniform float two_sided;
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
    light *= in_color;
    float grazing = 1.0 - max(facing, 0.0);
    float fresnel = 0.04 + 0.5 * grazing * grazing * grazing * grazing;
    high = pow(max(dot(n, normalize(KEY + v)), 0.0), gloss) * max(key, 0.0) * (0.6 + fresnel);
    high = (high + fresnel * 0.10) * shine * min(1.0, in_color.g * 1.6);
    uv = in_uv;
    normal = in_normal;
    gl_Position = view_projection * vec4(in_position, 1.0);
}
"""

# textures and pictures are taken as squared for linear light: close to sRGB, and cheap
_FRAGMENT = """
#version 330
uniform sampler2D base;
in vec2 uv;
in vec3 light;
in float high;
out vec4 color;
void main() {
    vec4 texel = texture(base, uv);
    color = vec4(sqrt(texel.rgb * texel.rgb * light + high), texel.a);
}
"""

_EYE_FRAGMENT = """
#version 330
uniform sampler2D base;
uniform vec3 half_way;
in vec2 uv;
in vec3 light;
in vec3 normal;
out vec4 color;
void main() {
    vec3 texel = texture(base, uv).rgb;
    float high = pow(max(dot(normalize(normal), half_way), 0.0), 400.0);
    color = vec4(sqrt(texel * texel * light + 1.6 * high), 1.0);
}
"""

_BACKDROP = """
#version 330
uniform vec3 middle;
uniform vec3 edge;
in vec2 place;
out vec4 color;
void main() {
    color = vec4(mix(middle, edge, min(1.0, dot(place, place) * 0.55)), 1.0);
}
"""

_BACKDROP_VERTEX = """
#version 330
in vec2 corner;
out vec2 place;
void main() {
    place = corner - vec2(0.0, 0.25);
    gl_Position = vec4(corner, 0.99999, 1.0);
}
"""

_EYES = ("eye_left", "eye_right")
_KEY = np.array([-0.42, 0.50, 0.80]) / np.linalg.norm([-0.42, 0.50, 0.80])  # as in the shader

# part: (wrap of the key light by channel, gloss exponent, strength of the highlight)
_MATERIALS: dict[str, tuple[tuple[float, float, float], float, float]] = {
    "skin": ((0.50, 0.34, 0.29), 22.0, 0.16),
    "garment": ((0.25, 0.25, 0.25), 8.0, 0.05),
    "eye_left": ((0.4, 0.36, 0.36), 8.0, 0.0),
    "eye_right": ((0.4, 0.36, 0.36), 8.0, 0.0),
    "teeth_upper": ((0.4, 0.36, 0.32), 60.0, 0.30),
    "teeth_lower": ((0.4, 0.36, 0.32), 60.0, 0.30),
    "tongue": ((0.5, 0.3, 0.3), 30.0, 0.20),
    "hair": ((0.3, 0.3, 0.3), 14.0, 0.05),
    "hair_tips": ((0.3, 0.3, 0.3), 14.0, 0.05),
    "lashes": ((0.0, 0.0, 0.0), 8.0, 0.0),
}
_PLAIN = ((0.3, 0.3, 0.3), 14.0, 0.08)  # of parts that bring no material known here


def standalone_context() -> moderngl.Context:
    """Open OpenGL 3.3 without a display.

    Raises
    ------
    UserError
        If the GL libraries are missing or give no context.
    """
    try:
        settings: dict[str, Any] = {"backend": "egl"}
        return moderngl.create_standalone_context(require=330, **settings)
    except Exception as error:  # moderngl raises bare Exception
        missing = [name for name in ("EGL", "GL") if ctypes.util.find_library(name) is None]
        found = f"lib{' and lib'.join(missing)} not found" if missing else str(error)
        raise UserError(
            f"OpenGL does not start without a display ({found}); install the Debian packages"
            f" {DEBIAN_PACKAGES}"
        ) from error


class Renderer:
    """Pictures of one head.

    Parameters
    ----------
    head
        Whom to draw.
    width_px, height_px
        Size of a picture.
    background
        sRGB colours of the middle and the edge, each 0 to 1; None for transparent pictures.
    samples
        Anti-aliasing samples a pixel; 0 for none.
    camera
        Where from.
    context
        OpenGL context of a window; by default one without a display.
    on_screen
        Draw into that window (``draw_on_screen``) and not beside it (``draw``).

    Raises
    ------
    UserError
        If OpenGL cannot start, the size is not positive, or a texture is damaged.
    """

    def __init__(
        self,
        head: Head,
        width_px: int,
        height_px: int,
        *,
        background: Background = BACKGROUND,
        samples: int = 4,
        camera: Camera | None = None,
        context: moderngl.Context | None = None,
        on_screen: bool = False,
    ) -> None:
        if width_px < 1 or height_px < 1:
            raise UserError(f"a picture of {width_px} x {height_px} pixels; give a positive size")
        self.head = head
        self.transparent = background is None
        self._background = background
        self._camera = camera or Camera()
        self._context = context or standalone_context()
        self._own_context = context is None
        self._on_screen = on_screen
        self._samples = min(samples, self._context.max_samples)
        self._program = self._context.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
        self._eye_program = self._context.program(
            vertex_shader=_VERTEX, fragment_shader=_EYE_FRAGMENT
        )
        self._backdrop_program = self._context.program(
            vertex_shader=_BACKDROP_VERTEX, fragment_shader=_BACKDROP
        )
        corners = np.array([-1, -1, 3, -1, -1, 3], dtype=np.float32)
        self._backdrop = self._context.vertex_array(
            self._backdrop_program, [(self._context.buffer(corners), "2f", "corner")]
        )
        self._moving = self._context.buffer(reserve=head.vertices.nbytes * 2, dynamic=True)
        self._stage = np.empty((len(head.vertices), 6), dtype=np.float32)
        self._load_parts()
        self._targets: list[Any] = []
        self.resize(width_px, height_px)

    def _load_parts(self) -> None:
        head, context = self.head, self._context
        fixed = np.concatenate([head.uv, head.colors], axis=1).astype(np.float32)
        fixed_buffer = context.buffer(fixed.tobytes())
        self._textures: dict[str, Any] = {}
        for name, encoded in head.textures.items():
            pixels = picture.decode(encoded, f"{head.name}: {name}")
            texture = context.texture(pixels.shape[1::-1], 4, pixels.tobytes())
            texture.build_mipmaps()
            texture.filter = (moderngl.LINEAR_MIPMAP_NEAREST, moderngl.LINEAR)
            texture.repeat_x = texture.repeat_y = False
            self._textures[name] = texture
        self._arrays = {}
        for part in head.parts:
            indices = context.buffer(head.triangles[part.triangles].tobytes())
            program = self._eye_program if part.name in _EYES else self._program
            self._arrays[part.name] = context.vertex_array(
                program,
                [
                    (self._moving, "3f 3f", "in_position", "in_normal"),
                    (fixed_buffer, "2f 3f", "in_uv", "in_color"),
                ],
                indices,
            )

    @property
    def description(self) -> str:
        """What draws, as OpenGL names it."""
        return str(self._context.info["GL_RENDERER"])

    def resize(self, width_px: int, height_px: int) -> None:
        """Change the size of the pictures."""
        self.size = (width_px, height_px)
        for target in self._targets:
            target.release()
        self._targets = []
        if not self._on_screen:
            self._result = self._framebuffer(0)
            multi = self._samples > 1
            self._canvas = self._framebuffer(self._samples) if multi else self._result
            # copying an empty picture takes less time than clearing and painting the background
            self._blank = self._framebuffer(self._samples if multi else 0)
            self._clear(self._blank)

    def _framebuffer(self, samples: int) -> Any:
        color = self._context.renderbuffer(self.size, 4, samples=samples)
        depth = self._context.depth_renderbuffer(self.size, samples=samples)
        target = self._context.framebuffer([color], depth)
        self._targets += [target, color, depth]
        return target

    def draw(self, faps: Float32) -> UInt8:
        """Draw one picture.

        Parameters
        ----------
        faps
            Facial animation parameters (68,), FAP units.

        Returns
        -------
        Pixels (H, W, 3), top row first; (H, W, 4) with alpha if the background is transparent.
        """
        self._upload(*self.head.pose(faps))
        self._draw()
        return self._read()

    def stages_s(self, faps: Float32) -> dict[str, float]:
        """Draw one picture and say how long deform, upload, draw and read back take, s."""
        times = [time.perf_counter()]

        def passed() -> None:
            self._context.finish()
            times.append(time.perf_counter())

        posed = self.head.pose(faps)
        passed()
        self._upload(*posed)
        passed()
        self._draw()
        passed()
        self._read()
        passed()
        names = ("deform", "upload", "draw", "read back")
        return dict(zip(names, np.diff(times).tolist(), strict=True))

    def _upload(self, vertices: Float32, normals: Float32) -> None:
        self._stage[:, :3], self._stage[:, 3:] = vertices, normals
        self._moving.write(self._stage)

    def _draw(self) -> None:
        self._context.copy_framebuffer(self._canvas, self._blank)
        self._paint(self._canvas)
        if self._canvas is not self._result:
            self._context.copy_framebuffer(self._result, self._canvas)

    def _read(self) -> UInt8:
        channels = 4 if self.transparent else 3
        width, height = self.size
        raw = self._result.read(components=channels, alignment=1)
        pixels = np.frombuffer(raw, np.uint8).reshape(height, width, channels)[::-1]
        return _unmixed(pixels) if self.transparent else pixels

    def draw_on_screen(self, faps: Float32) -> None:
        """Draw into the window the context came from."""
        screen = self._context.screen
        screen.viewport = (0, 0, *self.size)
        self._clear(screen)
        self._upload(*self.head.pose(faps))
        self._paint(screen)

    def _clear(self, target: Any) -> None:
        """Leave nothing but the background."""
        target.use()
        target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)
        self._context.enable_only(moderngl.NOTHING)
        if self._background is not None:
            middle, edge = self._background
            self._backdrop_program["middle"] = middle
            self._backdrop_program["edge"] = edge
            self._backdrop.render()

    def _paint(self, target: Any) -> None:
        context = self._context
        target.use()
        eye = np.array(self._camera.position)
        matrix = tuple(self._camera.view_projection(*self.size).T.ravel())
        for program in (self._program, self._eye_program):
            program["view_projection"] = matrix
            program["eye"] = self._camera.position
        half_way = _KEY + eye / np.linalg.norm(eye)
        self._eye_program["half_way"] = tuple(half_way / np.linalg.norm(half_way))
        for part in self.head.parts:
            if not part.transparent:
                culled = 0 if part.double_sided else moderngl.CULL_FACE
                context.enable_only(moderngl.DEPTH_TEST | culled)
                self._draw_part(part)
        context.enable_only(moderngl.DEPTH_TEST | moderngl.BLEND)
        # the second pair keeps the alpha of transparent pictures right
        factors: Any = (
            moderngl.SRC_ALPHA,
            moderngl.ONE_MINUS_SRC_ALPHA,
            moderngl.ONE,
            moderngl.ONE_MINUS_SRC_ALPHA,
        )
        context.blend_func = factors
        for part in self.head.parts:
            if part.transparent:
                self._draw_part(part)

    def _draw_part(self, part: Part) -> None:
        program = self._eye_program if part.name in _EYES else self._program
        wrap, gloss, shine = _MATERIALS.get(part.name, _PLAIN)
        for name, value in (
            ("wrap", wrap), ("gloss", gloss), ("shine", shine),
            ("two_sided", float(part.double_sided)),
        ):  # fmt: skip
            if name in program:
                program[name] = value
        self._textures[part.texture].use()
        self._arrays[part.name].render()

    def close(self) -> None:
        """Give the OpenGL context back."""
        if self._own_context:
            self._context.release()


def _unmixed(pixels: UInt8) -> UInt8:
    """Take the black background out of the colours where it shines through (H, W, 4)."""
    out = pixels.copy()
    row, column = np.nonzero((pixels[..., 3] > 0) & (pixels[..., 3] < 255))
    mixed = pixels[row, column].astype(np.float32)
    pure = mixed[:, :3] * (255 / mixed[:, 3:])
    out[row, column, :3] = np.minimum(np.round(pure), 255).astype(np.uint8)
    return out
