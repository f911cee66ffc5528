"""Bake the skin into a texture.

Both halves of the face share one texture. Its columns are the angle around a vertical axis inside
the head (0 in front, pi behind), its rows the height. Colors are sRGB, 0 to 1.
"""

from dataclasses import dataclass

import numpy as np
from scipy import interpolate, ndimage, spatial

from kouxing.shared.arrays import Doubles, Integers
from kouxing.training.heads.textures import Color, mix, noise

AXIS_Z = 0.35  # dm, of the vertical axis
TOP_Y, BOTTOM_Y = 6.85, 4.15  # dm
SKIN_SIZE = (1280, 832)  # rows, columns
_SHADE_REMOVED = 0.75  # exponent of the slow changes of MakeHuman's skins
_ANGLES = np.radians([0.0, 70.0, 110.0, 180.0])
_COLUMNS = np.array([0.0, 0.80, 0.92, 1.0])


def skin_uv(vertices: Doubles) -> Doubles:
    """Return the texture coordinates (V, 2) of points (V, 3)."""
    angle = np.abs(np.arctan2(np.abs(vertices[:, 0]), vertices[:, 2] - AXIS_Z))
    u = np.interp(angle, _ANGLES, _COLUMNS)
    v = (TOP_Y - vertices[:, 1]) / (TOP_Y - BOTTOM_Y)
    return np.asarray(np.clip(np.stack([u, v], axis=1), 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class FaceMap:
    """Positions of the skin's texels on the neutral face."""

    x: Doubles  # (H, W) dm, distance from the middle plane
    y: Doubles
    angle: Doubles
    source: Doubles  # (2, H, W) row and column in MakeHuman's skin, 0 to 1
    vertex: Integers  # (H, W) the nearest vertex


def face_map(vertices: Doubles, uv: Doubles, source: Doubles) -> FaceMap:
    """Interpolate from the outer skin's vertices (V, 3) of the left half to the texels.

    ``source`` (V, 2) are their coordinates in MakeHuman's skin, with v downward.
    """
    rows, columns = SKIN_SIZE
    v, u = np.meshgrid(
        (np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij"
    )
    values = np.concatenate([np.abs(vertices[:, :1]), source[:, ::-1]], axis=1)
    nearest = interpolate.NearestNDInterpolator(uv, values)
    linear = interpolate.LinearNDInterpolator(uv, values)(u, v)
    values = np.where(np.isfinite(linear), linear, nearest(u, v))
    # remove specks from points that a fold hides
    values = ndimage.median_filter(values, (9, 9, 1))
    values = ndimage.gaussian_filter(values, (2, 2, 0))
    return FaceMap(
        x=values[..., 0],
        y=TOP_Y - v * (TOP_Y - BOTTOM_Y),
        angle=np.interp(u, _COLUMNS, _ANGLES),
        source=np.moveaxis(values[..., 1:], 2, 0),
        vertex=spatial.cKDTree(uv).query(np.stack([u, v], axis=-1))[1],
    )


def resample(face: FaceMap, texture: Doubles, order: int) -> Doubles:
    """Move one of MakeHuman's skins (H, W, 3) to this texture's coordinates."""
    pixels = face.source * (np.array(texture.shape[:2]) - 1)[:, None, None]
    bands = [ndimage.map_coordinates(texture[..., k], pixels, order=order) for k in range(3)]
    return np.asarray(np.clip(np.stack(bands, axis=2), 0, 1))


def scalp(face: FaceMap, texture: Doubles) -> Doubles:
    """Return where hair grows (H, W), 0 to 1, from a skin with painted black hair."""
    light = resample(face, texture, 1).mean(axis=2)
    dark = np.clip((0.50 - light) / 0.25, 0, 1)
    groups, _ = ndimage.label(dark > 0.4)
    largest = np.bincount(groups.ravel())[1:].argmax() + 1
    dark *= ndimage.binary_dilation(groups == largest, iterations=12)
    parting = ndimage.grey_closing(dark, (61, 61))
    high = np.clip((face.y - 6.45) / 0.1, 0, 1)
    return np.asarray(dark + (parting - dark) * high)


def _soft_spot(face: FaceMap, x: float, y: float, width: float, height: float) -> Doubles:
    """Make a soft spot (H, W) on the front of the face."""
    spot = np.exp(-(((face.x - x) / width) ** 2) - ((face.y - y) / height) ** 2)
    return spot * np.clip((1.5 - face.angle) / 0.25, 0, 1)


@dataclass(frozen=True, slots=True)
class Look:
    """Colors (sRGB) and their strengths."""

    skin: Color = (0.890, 0.725, 0.625)
    lip: Color = (0.730, 0.430, 0.400)
    lip_strength: float = 0.80
    hair: Color = (0.180, 0.135, 0.115)
    brow: Color = (0.19, 0.140, 0.12)
    brow_strength: float = 1.3
    blush: float = 1.0
    stubble: float = 0.0
    age: float = 0.0  # wrinkles and spots
    iris: Color = (0.36, 0.22, 0.13)
    iris_size: float = 1.0
    lash_strength: float = 1.0
    lash_line: float = 1.0  # width of the dark edge of the upper lid
    cloth: Color = (0.20, 0.29, 0.38)
    cel: bool = False  # cel shading: plain colors, light and shade


def _inpaint(image: Doubles, hidden: Doubles) -> Doubles:
    """Replace the hidden part (H, W), 0 to 1, of an image (H, W, 3) by its surroundings."""
    weight = (1 - hidden)[..., None]
    sigma = (24, 24, 0)
    around = ndimage.gaussian_filter(image * weight, sigma)
    around /= ndimage.gaussian_filter(weight, sigma) + 1e-4
    return np.asarray(image * weight + around * (1 - weight))


def skin(
    face: FaceMap, lid: Doubles, lips: Doubles, look: Look, complexion: Doubles, roots: Doubles
) -> Doubles:
    """Paint the skin, sRGB (H, W, 3).

    ``lid`` and ``lips`` are outlines (N, 3): x, upper and lower height; both run outward, in dm.
    ``complexion`` (H, W, 3) is one of MakeHuman's skins, whose tone changes to the look's.
    ``roots`` (H, W) is the amount of hair on the scalp.
    """
    shape = face.x.shape

    def tone(red: float, green: float, blue: float) -> Color:
        """Tint the skin."""
        return red * look.skin[0], green * look.skin[1], blue * look.skin[2]

    usual = (face.x < 0.45) & (face.y > 5.3) & (face.y < 6.3) & (face.angle < 1.2)
    tones = complexion / np.median(complexion[usual], axis=0)
    # MakeHuman's skin has a seam below the jaw, and stubble on the scalp
    jaw = np.interp(face.angle, [0.0, 0.8, 1.3, 1.5, 1.7, 2.0], [4.95, 5.05, 5.20, 5.28, 5.4, 6.0])
    weight = np.clip((face.y - jaw) / 0.15, 0, 1) * np.clip((6.45 - face.y) / 0.2, 0, 1)
    tones = 1 + (tones - 1) * weight[..., None]
    # MakeHuman's skin has larger nostrils than the heads
    nose = np.clip(1.5 * _soft_spot(face, 0.10, 5.38, 0.17, 0.13), 0, 1)[..., None]
    tones += (ndimage.gaussian_filter(np.maximum(tones, 0.85), (18, 18, 0)) - tones) * nose
    # its lips have other outlines, and its tear ducts are folded
    mouth = _soft_spot(face, 0.0, 5.145, lips[-1, 0] + 0.07, 0.13)
    duct = _soft_spot(face, lid[0, 0] - 0.025, lid[0, 1] + 0.01, 0.055, 0.075)
    for hidden in (mouth, duct):
        tones = _inpaint(tones, np.clip(4 * hidden - 0.8, 0, 1))
    # its light and shade would not follow the light on the heads
    tones /= ndimage.gaussian_filter(tones, (36, 36, 0)) ** _SHADE_REMOVED
    image = np.array(look.skin) * tones ** np.where(look.cel, 0.3, 0.85)
    blotch = noise(shape, 26, 1)
    # the texture is squeezed at the thin neck, where grain would become streaks
    grain = np.clip((face.y - 4.70) / 0.25, 0.1, 1) * (not look.cel)
    image *= 1 + 0.012 * (grain * blotch)[..., None] * np.array([0.6, 1.0, 1.2])
    fine = 0.012 * noise(shape, 1.1, 2) + 0.008 * noise(shape, 3.5, 3)
    image *= 1 + (grain * fine)[..., None]
    rosy = tone(1.01, 0.77, 0.80)
    image = mix(image, rosy, 0.26 * look.blush * _soft_spot(face, 0.42, 5.42, 0.20, 0.17))
    if look.stubble:
        image = _paint_stubble(image, face, look.stubble, tone(0.74, 0.79, 0.86), lips)
    if look.age:
        image = _paint_age(image, face, look.age)
    image = _paint_lips(image, face, lips, look)
    image = _paint_eye_lines(image, face, lid[:, :2], lid[:, 2], look.lash_line)
    strands = np.array(look.hair) * (1 + 0.15 * noise(shape, (9, 1.2), 5)[..., None])
    return np.clip(image + (strands - image) * (0.85 * roots)[..., None], 0, 1)


def _paint_stubble(
    image: Doubles, face: FaceMap, amount: float, color: Color, lips: Doubles
) -> Doubles:
    """Tint the shaven parts of the face: upper lip, chin, jaw and sideburns."""
    top = np.interp(
        face.angle, [0.0, 0.30, 0.55, 0.95, 1.25, 1.45], [5.10, 5.12, 5.16, 5.28, 5.55, 5.70]
    )
    jaw = 1 / (1 + np.exp((face.y - top) / 0.03)) * np.clip((face.y - 4.60) / 0.25, 0, 1)
    jaw *= np.clip((1.60 - face.angle) / 0.45, 0, 1)
    lip = np.clip(1.1 * _soft_spot(face, 0.10, 5.235, 0.12, 0.04), 0, 1) * (face.y < 5.32)
    upper = np.interp(face.x, lips[:, 0], lips[:, 1])
    lip *= np.clip((face.y - upper - 0.008) / 0.015, 0, 1)
    soul = 1 - 0.6 * _soft_spot(face, 0.0, 5.01, 0.20, 0.05)
    dots = np.clip(0.75 + 0.30 * noise(face.x.shape, 0.9, 21), 0.2, 1.2)
    return mix(image, color, amount * np.maximum(jaw * soul, lip) * dots)


# wrinkles as x and y in dm, and their depth: forehead, between the brows, outer corner of the eye,
# under the eye, around the mouth, chin, neck
_WRINKLES = (
    (((0.0, 6.335), (0.15, 6.345), (0.33, 6.32)), 0.45),
    (((0.0, 6.255), (0.20, 6.27), (0.40, 6.23)), 0.65),
    (((0.0, 6.175), (0.20, 6.195), (0.42, 6.15)), 0.55),
    (((0.055, 5.93), (0.050, 6.00), (0.062, 6.07)), 0.25),
    (((0.45, 5.81), (0.51, 5.835), (0.57, 5.875)), 0.40),
    (((0.45, 5.78), (0.52, 5.78), (0.58, 5.785)), 0.45),
    (((0.45, 5.745), (0.50, 5.715), (0.55, 5.67)), 0.40),
    (((0.165, 5.73), (0.25, 5.675), (0.34, 5.675), (0.41, 5.72)), 0.65),
    (((0.19, 5.665), (0.27, 5.61), (0.36, 5.605)), 0.35),
    (((0.195, 5.43), (0.245, 5.34), (0.285, 5.24), (0.305, 5.13)), 0.8),
    (((0.265, 5.10), (0.285, 5.02), (0.27, 4.94)), 0.55),
    (((0.0, 4.985), (0.08, 4.98), (0.15, 4.95)), 0.35),
    (((0.0, 4.50), (0.20, 4.51), (0.40, 4.56)), 0.45),
)


def _paint_age(image: Doubles, face: FaceMap, amount: float) -> Doubles:
    texels = np.stack([face.x, face.y], axis=-1)
    waver = 0.004 * noise(face.x.shape, 9, 22)
    for points, depth in _WRINKLES:
        line = np.array(points)
        steps = np.linspace(0, 1, 80)
        curve = interpolate.make_interp_spline(np.linspace(0, 1, len(line)), line, 2)(steps)
        near = (np.abs(texels - curve.mean(axis=0)) < np.ptp(curve, axis=0) / 2 + 0.06).all(axis=-1)
        near &= face.angle < 1.6
        away, index = spatial.cKDTree(curve).query(texels[near])
        above = (texels[near] - curve[index])[:, 1]
        fade = np.sin(np.pi * np.clip(0.02 + 0.96 * steps[index], 0, 1))
        if line[0, 0] == 0.0:  # the line continues across the middle
            fade = np.cos(np.pi / 2 * steps[index])
        across = away + waver[near]
        groove = np.exp(-((across / 0.009) ** 2)) + 0.45 * np.exp(-((across / 0.028) ** 2))
        rim = np.exp(-(((away - 0.022) / 0.012) ** 2)) * (above < 0)
        shade = amount * depth * fade
        shaded = image[near] * (1 - shade[:, None] * groove[:, None] * [0.17, 0.24, 0.27])
        image[near] = shaded * (1 + 0.05 * (shade * rim)[:, None])
    spots = np.clip(noise(face.x.shape, 5, 23) - 2.3, 0, 1) * (face.angle > 0.35)
    image = mix(image, (0.60, 0.42, 0.33), 0.55 * amount * spots)
    return image * (1 + 0.012 * amount * noise(face.x.shape, 12, 24)[..., None])


def _paint_lips(image: Doubles, face: FaceMap, lips: Doubles, look: Look) -> Doubles:
    upper, lower = (np.interp(face.x, lips[:, 0], lips[:, column]) for column in (1, 2))
    upper = upper - 0.012 * np.exp(-((face.x / 0.024) ** 2))  # Cupid's bow
    edge = 0.0065
    inset = np.clip((lips[-1, 0] - face.x) / 0.07, 0, 1)  # 0 at the corner
    inside = 1 / (1 + np.exp((face.y - upper + 0.004 * inset) / edge))
    inside *= 1 / (1 + np.exp((lower + 0.012 * inset - face.y) / edge))
    inside *= 1 / (1 + np.exp((face.x - lips[-1, 0] + 0.004) / 0.006))
    inside *= face.angle < 1.5
    lines = noise(face.x.shape, (14, 1.8), 4)
    color = np.array(look.lip) * (1 + 0.022 * lines[..., None])
    image = image + (color - image) * (look.lip_strength * inside)[..., None]
    below = _soft_spot(face, 0.0, 5.005, 0.15, 0.024) * (1 - inside)
    return np.asarray(image * (1 - 0.30 * below[..., None] * [0.21, 0.34, 0.33]))


def _paint_eye_lines(
    image: Doubles, face: FaceMap, lid: Doubles, lower: Doubles, width: float
) -> Doubles:
    edge = np.interp(face.x, lid[:, 0], lid[:, 1])
    inside = 1 / (1 + np.exp(-(face.x - lid[0, 0] - 0.01) / 0.008))
    inside *= 1 / (1 + np.exp((face.x - lid[-1, 0] - 0.02) / 0.012))
    height = face.y - edge
    line = np.exp(-((height / (0.011 * width)) ** 2)) * inside
    fold = np.exp(-(((height - 0.052) / 0.010) ** 2)) * inside
    below = np.interp(face.x, lid[:, 0], lower)
    rim = np.exp(-(((face.y - below) / 0.010) ** 2)) * inside
    image = mix(image, (0.90, 0.70, 0.66), 0.45 * rim)  # the wet line
    image = mix(image, (0.16, 0.10, 0.09), 0.80 * line)
    return mix(image, (0.60, 0.41, 0.36), 0.32 * fold)
