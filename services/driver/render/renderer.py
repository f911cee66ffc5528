"""Draws a head with OpenGL, either offscreen (EGL) or in an existing window."""

import ctypes.util
import sys
import time
from dataclasses import dataclass
from typing import Any

import moderngl
import numpy as np

from kouxing.services.driver import picture
from kouxing.services.driver.head.head import Head, HeadPart
from kouxing.services.driver.render import shaders
from kouxing.shared.arrays import Floats, UInt8
from kouxing.shared.errors import UserError

Background = tuple[tuple[float, ...], tuple[float, ...]] | None  # sRGB of center and edge

BACKGROUND = ((0.62, 0.69, 0.75), (0.36, 0.43, 0.50))
_MIN_ASPECT = 0.7  # narrower pictures show more above and below so that the face still fits
_TEETH_DEPTH = 500.0  # from the lips at rest to the teeth, FAP units (MNS / 1024)
_LIGHT_SPREAD = 0.25
_LIGHT_FLOOR = 0.08
DEBIAN_PACKAGES = "libegl1 libgl1 libgl1-mesa-dri"


@dataclass(frozen=True, slots=True)
class Camera:
    """Camera position and lens; lengths in m, in the head's axes."""

    position: tuple[float, float, float] = (0.0, 0.030, 1.015)
    target: tuple[float, float, float] = (0.0, 0.018, 0.0)
    field_of_view_deg: float = 15.0  # vertical

    def view_projection(self, width_px: int, height_px: int) -> Floats:
        """Return the matrix (4, 4) from the head's axes to clip space."""
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
        scale *= min(1.0, width_px / height_px / _MIN_ASPECT)
        projection = np.zeros((4, 4))
        projection[0, 0], projection[1, 1] = scale * height_px / width_px, scale
        projection[2, 2:] = (far + near) / (near - far), 2 * far * near / (near - far)
        projection[3, 2] = -1.0
        return np.asarray(projection @ view, dtype=np.float32)


def create_offscreen_context() -> moderngl.Context:
    """Create an OpenGL 3.3 context without a display.

    Raises ``UserError`` if the GL libraries are missing or cannot create a context.
    """
    try:
        # macOS has no EGL; its OpenGL needs no display
        settings: dict[str, Any] = {} if sys.platform == "darwin" else {"backend": "egl"}
        return moderngl.create_standalone_context(require=330, **settings)
    except Exception as error:  # moderngl raises bare Exception
        missing = [name for name in ("EGL", "GL") if ctypes.util.find_library(name) is None]
        reason = f"lib{' and lib'.join(missing)} not found" if missing else str(error)
        raise UserError(
            f"OpenGL cannot start without a display ({reason}); install the Debian packages"
            f" {DEBIAN_PACKAGES}"
        ) from error


class Renderer:
    """Draws pictures of one head, offscreen by default.

    Without a ``background`` pictures are transparent. ``samples`` per pixel are for anti-aliasing.
    ``context`` is the OpenGL context of a window; with ``on_screen``, ``draw_on_screen`` draws into
    that window.

    Raises ``UserError`` if OpenGL cannot start, the size is not positive, or a texture is damaged.
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
            raise UserError(f"cannot draw {width_px} x {height_px} pixels; use a positive size")
        self.head = head
        self.transparent = background is None
        self._background = background
        self._camera = camera or Camera()
        self._context = context or create_offscreen_context()
        self._owns_context = context is None
        self._on_screen = on_screen
        self._samples = min(samples, self._context.max_samples)
        self._program, self._cutout_program, self._eye_program, self._backdrop_program = (
            self._context.program(vertex_shader=vertex, fragment_shader=fragment)
            for vertex, fragment in (
                (shaders.VERTEX, shaders.FRAGMENT),
                (shaders.VERTEX, shaders.CUTOUT_FRAGMENT),
                (shaders.VERTEX, shaders.EYE_FRAGMENT),
                (shaders.BACKDROP_VERTEX, shaders.BACKDROP),
            )
        )
        corners = np.array([-1, -1, 3, -1, -1, 3], dtype=np.float32)
        self._backdrop = self._context.vertex_array(
            self._backdrop_program, [(self._context.buffer(corners), "2f", "corner")]
        )
        self._vertex_buffer = self._context.buffer(reserve=head.vertices.nbytes * 2, dynamic=True)
        self._vertex_data = np.empty((len(head.vertices), 6), dtype=np.float32)
        self._load_parts()
        self._targets: list[Any] = []
        self.resize(width_px, height_px)

    def _load_parts(self) -> None:
        head, context = self.head, self._context
        static_attributes = np.concatenate([head.uv, head.colors], axis=1).astype(np.float32)
        static_buffer = context.buffer(static_attributes.tobytes())
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
            self._arrays[part.name] = context.vertex_array(
                self._part_program(part),
                [
                    (self._vertex_buffer, "3f 3f", "in_position", "in_normal"),
                    (static_buffer, "2f 3f", "in_uv", "in_color"),
                ],
                indices,
            )

    @property
    def description(self) -> str:
        """Name of the graphics driver."""
        return str(self._context.info["GL_RENDERER"])

    def resize(self, width_px: int, height_px: int) -> None:
        """Change the size of the pictures."""
        self.size = (width_px, height_px)
        for target in self._targets:
            target.release()
        self._targets = []
        if not self._on_screen:
            self._result = self._framebuffer(0)
            is_multisampled = self._samples > 1
            self._canvas = self._framebuffer(self._samples) if is_multisampled else self._result
            # copying a prepared picture is faster than clearing and painting the background
            self._blank = self._framebuffer(self._samples if is_multisampled else 0)
            self._clear(self._blank)

    def _framebuffer(self, samples: int) -> Any:
        color = self._context.renderbuffer(self.size, 4, samples=samples)
        depth = self._context.depth_renderbuffer(self.size, samples=samples)
        target = self._context.framebuffer([color], depth)
        self._targets += [target, color, depth]
        return target

    def draw(self, faps: Floats) -> UInt8:
        """Draw FAPs (68,); return pixels (H, W, 3), or (H, W, 4) with alpha if transparent."""
        self._upload(*self.head.pose(faps), faps)
        self._draw()
        return self._read()

    def measure_stages_s(self, faps: Floats) -> dict[str, float]:
        """Draw one picture; return the durations of deform, upload, draw and read-back, seconds."""
        times = [time.perf_counter()]

        def finish_stage() -> None:
            self._context.finish()
            times.append(time.perf_counter())

        posed = self.head.pose(faps)
        finish_stage()
        self._upload(*posed, faps)
        finish_stage()
        self._draw()
        finish_stage()
        self._read()
        finish_stage()
        names = ("deform", "upload", "draw", "read back")
        return dict(zip(names, np.diff(times).tolist(), strict=True))

    def _upload(self, vertices: Floats, normals: Floats, faps: Floats) -> None:
        self._mouth_light = mouth_light(faps)
        self._vertex_data[:, :3], self._vertex_data[:, 3:] = vertices, normals
        self._vertex_buffer.write(self._vertex_data)

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
        return _remove_background(pixels) if self.transparent else pixels

    def draw_on_screen(self, faps: Floats) -> None:
        """Draw into the window that the context belongs to."""
        screen = self._context.screen
        screen.viewport = (0, 0, *self.size)
        self._clear(screen)
        self._upload(*self.head.pose(faps), faps)
        self._paint(screen)

    def _clear(self, target: Any) -> None:
        """Fill with the background."""
        target.use()
        target.clear(0.0, 0.0, 0.0, 0.0, depth=1.0)
        self._context.enable_only(moderngl.NOTHING)
        if self._background is not None:
            center, edge = self._background
            self._backdrop_program["center"] = center
            self._backdrop_program["edge"] = edge
            self._backdrop.render()

    def _paint(self, target: Any) -> None:
        context = self._context
        target.use()
        matrix = tuple(self._camera.view_projection(*self.size).T.ravel())
        for program in (self._program, self._cutout_program, self._eye_program):
            program["view_projection"] = matrix
            program["eye"] = self._camera.position
        for part in self.head.parts:
            if not part.transparent:
                culled = 0 if part.double_sided else moderngl.CULL_FACE
                context.enable_only(moderngl.DEPTH_TEST | culled)
                self._draw_part(part)
        context.enable_only(moderngl.DEPTH_TEST | moderngl.BLEND)
        # the second pair keeps the alpha channel of transparent pictures correct
        others = moderngl.ONE_MINUS_SRC_ALPHA
        factors: Any = (moderngl.SRC_ALPHA, others, moderngl.ONE, others)
        context.blend_func = factors
        # only hair hides what is behind it
        blended = [part for part in self.head.parts if part.transparent]
        for part in sorted(blended, key=lambda part: part.name != shaders.HAIR_PART):
            target.depth_mask = part.name == shaders.HAIR_PART
            self._draw_part(part)
        target.depth_mask = True

    def _part_program(self, part: HeadPart) -> Any:
        if part.name in shaders.EYE_PARTS:
            return self._eye_program
        return self._cutout_program if part.transparent else self._program

    def _draw_part(self, part: HeadPart) -> None:
        program = self._part_program(part)
        wrap, gloss, shine = shaders.MATERIALS.get(part.name, shaders.PLAIN_MATERIAL)
        for name, value in (
            ("wrap", wrap), ("gloss", gloss), ("shine", shine),
            ("two_sided", part.double_sided),
            ("strands", part.name == shaders.HAIR_PART),
            ("cutoff", shaders.HAIR_CUTOFF if part.name == shaders.HAIR_PART else shaders.CUTOFF),
            ("cel", self.head.cel and part.name not in shaders.EYE_PARTS),
            ("share", self._mouth_light if part.name in shaders.MOUTH_PARTS else 1.0),
        ):  # fmt: skip
            if name in program:
                program[name] = value
        self._textures[part.texture].use()
        self._arrays[part.name].render()

    def close(self) -> None:
        """Release the OpenGL context."""
        if self._owns_context:
            self._context.release()


def _remove_background(pixels: UInt8) -> UInt8:
    """Remove the black background from translucent pixels (H, W, 4)."""
    out = pixels.copy()
    row, column = np.nonzero((pixels[..., 3] > 0) & (pixels[..., 3] < 255))
    mixed = pixels[row, column].astype(np.float32)
    pure = mixed[:, :3] * (255 / mixed[:, 3:])
    out[row, column, :3] = np.minimum(np.round(pure), 255).astype(np.uint8)
    return out


def mouth_light(faps: Floats) -> float:
    """Return the fraction of the light on teeth and tongue, 0 to 1, for FAPs (68,).

    Little light passes a small mouth or protruding lips. The light passes the gap between the lips,
    of height ``h``, onto teeth at a depth ``d``. It increases with ``h`` and decreases with ``d``;
    the formula was chosen by eye. ``services/gateway/page/mouth-light.js`` is the same function.
    """
    height = max(-float(faps[3] + faps[4]), 0.0)
    depth = max(_TEETH_DEPTH + float(faps[15] + faps[16]) / 2, 0.0)
    through = height / (height + _LIGHT_SPREAD * depth**2 / _TEETH_DEPTH + 1e-6)
    return min(1.0, _LIGHT_FLOOR + through)
