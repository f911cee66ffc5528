"""Textures: noise, mixing, encoding, and MakeHuman's textures in new colors.

Colors are sRGB, 0 to 1. Hair, brows and lashes are gray with alpha; vertex colors tint them.
"""

import io
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from kouxing.shared.arrays import Doubles, Integers
from kouxing.training.heads.fitted_mesh import find
from kouxing.training.heads.parts import EYE_RINGS, IRIS_ANGLE, PUPIL_ANGLE

Color = tuple[float, float, float]

GRAY = 0.75  # mean of the gray textures
_JPEG_QUALITY = 88
_SHADE = 24.0  # texels; changes of the brightness over longer distances are shade
_SHADE_KEPT = 0.25  # exponent of the shade
_MAX_RISE = -np.log(GRAY)  # makes gray white
_SHADOW_WIDTH = 0.006  # of hairs, relative to the texture's height
_RELIEF = 8.0  # slope at a relative change of the brightness from one texel to the next


def noise(shape: tuple[int, int], sigma: float | tuple[float, float], seed: int) -> Doubles:
    """Make smooth noise of unit variance."""
    white = np.random.default_rng(seed).standard_normal(shape)
    smooth: Doubles = ndimage.gaussian_filter(white, sigma, mode="wrap")
    smooth /= smooth.std()
    return smooth


def mix(image: Doubles, color: Color, amount: Doubles) -> Doubles:
    """Blend a color into an image (H, W, 3) by an amount (H, W)."""
    return image + (np.array(color) - image) * np.clip(amount, 0, 1)[..., None]


def load(folder: Path, name: str, size: int = 0) -> Doubles:
    """Read one of MakeHuman's textures (H, W, 3 or 4), with ``size`` reduced to a square."""
    with Image.open(find(folder, name)) as file:
        image = file.convert("RGBA" if "A" in file.getbands() else "RGB")
    if size and image.width > size:
        image = image.resize((size, size), Image.Resampling.BOX)
    return np.asarray(image, dtype=np.float64) / 255


def encode(image: Doubles) -> bytes:
    """Encode (H, W, 3) as JPEG, (H, W, 2) of gray and alpha as PNG."""
    pixels = np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)
    file = io.BytesIO()
    if pixels.shape[2] == 2:
        Image.fromarray(pixels, "LA").save(file, "PNG", optimize=True)
    else:
        Image.fromarray(pixels).save(file, "JPEG", quality=_JPEG_QUALITY, optimize=True)
    return file.getvalue()


def strands(texture: Doubles, contrast: float) -> Doubles:
    """Make a hair texture (H, W, 4) gray with the mean ``GRAY``; return (H, W, 2) with alpha.

    MakeHuman painted light and shade into its hair. Only a part of it is kept, because the heads
    are lit. ``contrast`` is the exponent of the strands' brightness.
    """
    # a wide soft edge would look like a veil
    opaque = np.clip((texture[..., 3] - 0.25) / 0.4, 0, 1)
    # the scalp would shine through gaps, but strands end at the edge
    closed = ndimage.grey_closing(opaque, (15, 15))
    inside = ndimage.distance_transform_edt(closed > 0.5)
    alpha = opaque + (closed - opaque) * np.clip((inside - 3) / 5, 0, 1)
    light = texture[..., :3].mean(axis=2)
    weight = opaque + 1e-6
    near = ndimage.gaussian_filter(light * weight, _SHADE) / ndimage.gaussian_filter(weight, _SHADE)
    near = np.maximum(near, 1e-3)
    usual = np.average(light, weights=opaque)
    change = contrast * np.log(np.maximum(light, 1e-3) / near) + _SHADE_KEPT * np.log(near / usual)
    gray = GRAY * np.exp(
        np.where(change > 0, _MAX_RISE, 1.0)
        * np.tanh(change / np.where(change > 0, _MAX_RISE, 1.0))
    )
    # the color of transparent texels would shine through at the edges
    near = ndimage.distance_transform_edt(opaque < 0.5, return_indices=True, return_distances=False)
    gray = gray[tuple(near)]
    return np.stack([np.round(gray * 40) / 40, np.round(alpha * 16) / 16], axis=2)


def sample_alpha(triangles: Integers, uv: Doubles, alpha: Doubles) -> Doubles:
    """Return alpha at N points of each triangle (F, N); ``uv`` (V, 2) has v downward."""
    steps = np.linspace(0.02, 0.96, 9)
    barycentric = np.array([(a, b, 1 - a - b) for a in steps for b in steps if a + b < 1])
    pixels = np.einsum("sk,fkd->fsd", barycentric, uv[triangles]) * (alpha.shape[1], alpha.shape[0])
    column, row = np.clip(pixels.astype(int), 0, np.array(alpha.shape[::-1]) - 1).transpose(2, 0, 1)
    return np.asarray(alpha[row, column])


def hairs(texture: Doubles, strength: float) -> Doubles:
    """Return the alpha of brows or lashes (H, W, 4), scaled, as even gray with alpha (H, W, 2)."""
    drawn = texture[..., 3]
    # hairs that are thinner than a pixel would fade; their soft shadow fills the gaps
    dense = np.maximum(drawn, ndimage.gaussian_filter(drawn, _SHADOW_WIDTH * len(drawn)))
    alpha = np.round(np.clip(dense * strength, 0, 1) * 16) / 16  # compresses well
    return np.stack([np.full_like(alpha, GRAY), alpha], axis=2)


def relief(image: Doubles) -> Doubles:
    """Return a normal map (H / 2, W / 2, 3) whose fine dark details are deep."""
    gray = image.mean(axis=2)
    gray = gray.reshape(gray.shape[0] // 2, 2, gray.shape[1] // 2, 2).mean(axis=(1, 3))
    gray /= np.maximum(ndimage.gaussian_filter(gray, 12), 0.05)
    high = gray - ndimage.gaussian_filter(gray, 5)
    down, right = (np.clip(_RELIEF * slope, -0.5, 0.5) for slope in np.gradient(high))
    normal = np.stack([-right, down, np.ones_like(right)], axis=2)
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    return np.asarray(0.5 + 0.5 * normal)


def tint(color: Color) -> Doubles:
    """Return the linear factor (3,) that gives a gray texture a color."""
    return np.asarray(np.minimum((np.array(color) / GRAY) ** 2, 1.0))


_EYE_CENTER = (302, 727)  # center of an eye in MakeHuman's texture, row and column
_EYE_IRIS, _EYE_WHITE = 118.0, 250.0  # radii in that texture


def eye(texture: Doubles, color: Color, iris_size: float = 1.0, size: int = 512) -> Doubles:
    """Turn MakeHuman's eye into a view from the front, with the angle from the pupil as radius.

    ``color`` is the color of the iris, ``iris_size`` scales iris and pupil.
    """
    place = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(place, place)
    angle = np.maximum(np.hypot(x, y) * EYE_RINGS[-1], 1e-6)
    angle_of_iris = IRIS_ANGLE * iris_size
    radius = np.interp(
        angle, [0, angle_of_iris, EYE_RINGS[-1]], [0, _EYE_IRIS, _EYE_WHITE]
    )  # fmt: skip
    turn = np.arctan2(y, x)
    pixel = np.array(
        [_EYE_CENTER[0] + radius * np.sin(turn), _EYE_CENTER[1] + radius * np.cos(turn)]
    )
    image = np.stack(
        [ndimage.map_coordinates(texture[..., k], pixel, order=1) for k in range(3)], axis=2
    )
    light = image.mean(axis=2)
    within = radius / _EYE_IRIS
    dark = 1 - 0.30 * np.clip((within - 1) / 0.9, 0, 1) ** 2  # darker toward the corners
    white = np.clip(image * np.array([1.42, 1.41, 1.41]), 0, 0.90) * dark[..., None]
    # MakeHuman's iris is dark; the light through the cornea brightens its lower half
    detail = light / np.median(light[(within > 0.5) & (within < 0.9)])
    lit = 0.72 + 0.28 * detail + 0.30 * np.clip(y / angle_of_iris, -0.5, 0.7)
    iris = (
        np.array(color)
        * (lit * np.interp(within, [0.3, 0.5, 0.8, 1.0], [0.8, 1.1, 0.9, 0.4]))[..., None]
    )
    edge = 1 / (1 + np.exp((within - 1.0) / 0.035))
    image = white + (np.clip(iris, 0, 1) - white) * edge[..., None]
    pupil = 1 / (1 + np.exp((angle - PUPIL_ANGLE * iris_size) / 0.012))
    return np.clip(mix(image, (0.015, 0.012, 0.012), pupil), 0, 1)


def teeth(texture: Doubles) -> Doubles:
    """Whiten the enamel of MakeHuman's teeth, and make the gums paler (H, W, 3)."""
    colors = texture[..., :3]
    light = colors.mean(axis=2, keepdims=True)
    red = colors[..., :1] - colors[..., 1:2]
    is_gum = np.clip((red - 0.10) / 0.12, 0, 1)
    enamel = np.array([0.92, 0.88, 0.81]) * np.clip(0.62 + 0.52 * light, 0, 1.02)
    gum = np.array([0.80, 0.47, 0.47]) * np.clip(0.55 + 1.0 * light, 0, 1.25)
    return np.asarray(np.clip(enamel + (gum - enamel) * is_gum, 0, 1))


def tongue(size: int = 128) -> Doubles:
    """Paint the tongue from above, with its tip at the bottom: papillae and a groove."""
    rough = 0.06 * noise((size, size), 0.8, 9) + 0.02 * noise((size, size), 4.0, 10)
    across = (np.arange(size) + 0.5) / size - 0.5
    groove = 0.22 * np.exp(-((across / 0.035) ** 2))
    image = np.array([0.80, 0.45, 0.44]) * (1 + rough - groove)[..., None]
    paler = np.clip(1.5 * rough, 0, 1)  # the tops of the papillae
    return np.clip(mix(image, (0.93, 0.68, 0.66), paler), 0, 1)


def cloth(color: Color, size: int = 16) -> Doubles:
    """Paint a plain knitted fabric."""
    return np.broadcast_to(np.array(color), (size, size, 3)).copy()
