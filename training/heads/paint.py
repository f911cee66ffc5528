"""Bake the skin into a texture.

Both halves of the face share one texture. Its columns are the angle around a vertical axis inside
the head (0 in front, pi behind), its rows the height. Colors are sRGB, 0 to 1.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import interpolate, ndimage, spatial

from kouxing.training.heads.hair_styles import Hair
from kouxing.training.heads.paint_parts import Color, mix, noise

Float = NDArray[np.float64]

AXIS_Z = 0.35  # dm, of the vertical axis
TOP_Y, BOTTOM_Y = 6.85, 4.15  # dm
SKIN_SIZE = (1280, 832)  # rows, columns
_ANGLES = np.radians([0.0, 70.0, 110.0, 180.0])
_COLUMNS = np.array([0.0, 0.80, 0.92, 1.0])


def skin_uv(vertices: Float) -> Float:
    """Return the texture coordinates (V, 2) of points (V, 3)."""
    angle = np.abs(np.arctan2(np.abs(vertices[:, 0]), vertices[:, 2] - AXIS_Z))
    u = np.interp(angle, _ANGLES, _COLUMNS)
    v = (TOP_Y - vertices[:, 1]) / (TOP_Y - BOTTOM_Y)
    return np.asarray(np.clip(np.stack([u, v], axis=1), 0.0, 1.0))


@dataclass(frozen=True, slots=True)
class FaceMap:
    """Positions of the skin's texels on the neutral face."""

    x: Float  # (H, W) dm, distance from the middle plane
    y: Float
    z: Float
    angle: Float


def face_map(vertices: Float, uv: Float) -> FaceMap:
    """Interpolate positions from the outer skin's vertices to the texels."""
    rows, columns = SKIN_SIZE
    v, u = np.meshgrid(
        (np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij"
    )
    values = np.abs(vertices)
    nearest = interpolate.NearestNDInterpolator(uv, values)
    linear = interpolate.LinearNDInterpolator(uv, values)(u, v)
    values = np.where(np.isfinite(linear), linear, nearest(u, v))
    # remove specks from points that a fold hides
    values = ndimage.median_filter(values, (9, 9, 1))
    values = ndimage.gaussian_filter(values, (2, 2, 0))
    return FaceMap(
        x=values[..., 0],
        y=TOP_Y - v * (TOP_Y - BOTTOM_Y),
        z=values[..., 2],
        angle=np.interp(u, _COLUMNS, _ANGLES),
    )


def _spot(
    face: FaceMap, x: float, y: float, width: float, height: float, until: float = 1.5
) -> Float:
    """Make a soft spot (H, W) at a place of the face, up to the angle ``until``."""
    spot = np.exp(-(((face.x - x) / width) ** 2) - ((face.y - y) / height) ** 2)
    return spot * np.clip((until - face.angle) / 0.25, 0, 1)


@dataclass(frozen=True, slots=True)
class Look:
    """Colors (sRGB) and their strengths."""

    skin: Color = (0.890, 0.725, 0.625)
    lip: Color = (0.720, 0.405, 0.385)
    lip_strength: float = 0.80
    hair: Color = (0.175, 0.130, 0.112)
    brow: Color = (0.23, 0.165, 0.14)
    brow_width: float = 1.0
    brow_strength: float = 1.0
    blush: float = 1.0
    stubble: float = 0.0
    age: float = 0.0  # wrinkles and spots
    iris: Color = (0.36, 0.22, 0.13)
    iris_size: float = 1.0
    lash_line: float = 1.0  # width of the dark edge of the upper lid
    cloth: Color = (0.20, 0.29, 0.38)
    cel: bool = False  # cel shading: plain colors, light and shade


def skin(face: FaceMap, brow: Float, lid: Float, lips: Float, look: Look, hair: Hair) -> Float:
    """Paint the skin, sRGB (H, W, 3).

    ``brow`` is the middle line of a brow (3, 2), x and y. ``lid`` and ``lips`` are outlines (N, 3):
    x, upper and lower height. All run outward, in dm.
    """
    shape = face.x.shape
    image = np.broadcast_to(np.array(look.skin), (*shape, 3)).copy()

    def tone(red: float, green: float, blue: float) -> Color:
        """Tint the skin."""
        return red * look.skin[0], green * look.skin[1], blue * look.skin[2]

    blotch = noise(shape, 26, 1)
    # the texture is squeezed at the thin neck, where grain would become streaks
    grain = np.clip((face.y - 4.70) / 0.25, 0.1, 1) * (not look.cel)
    image *= 1 + 0.010 * (grain * blotch)[..., None] * np.array([0.6, 1.0, 1.2])
    fine = 0.010 * noise(shape, 1.1, 2) + 0.006 * noise(shape, 3.5, 3)
    image *= 1 + (grain * fine)[..., None]
    rosy = tone(1.01, 0.77, 0.80)
    image = mix(image, rosy, 0.30 * look.blush * _spot(face, 0.42, 5.42, 0.20, 0.17))
    image = mix(image, rosy, 0.16 * _spot(face, 0.0, 5.46, 0.10, 0.10))
    image = mix(image, rosy, 0.10 * _spot(face, 0.0, 4.92, 0.16, 0.10))
    ear = _spot(face, 0.76, 5.60, 0.06, 0.25, until=2.0) * (face.angle > 1.3)
    image = mix(image, rosy, 0.20 * ear)
    image = mix(image, tone(0.90, 0.83, 0.85), 0.22 * _spot(face, 0.28, 5.70, 0.13, 0.035))
    image = mix(image, tone(0.88, 0.79, 0.82), 0.18 * _spot(face, 0.27, 5.885, 0.14, 0.05))
    image = mix(image, tone(1.07, 1.10, 1.12), 0.25 * _spot(face, 0.0, 6.15, 0.35, 0.20))
    if look.stubble:
        image = _paint_stubble(image, face, look.stubble, tone(0.74, 0.79, 0.86), lips)
    if look.age:
        image = _paint_age(image, face, look.age)
    image = _paint_lips(image, face, lips, look)
    image = _paint_eye_lines(image, face, lid[:, :2], lid[:, 2], look.lash_line)
    image = _paint_brow(image, face, brow, look)
    ragged = 0.04 * noise(shape, (14, 1.3), 6) + 0.08 * noise(shape, (30, 12), 7)
    roots = hair.roots(face.x, face.y, face.z) + ragged
    return np.clip(mix(image, look.hair, np.clip(roots + 0.3, 0, 1) ** 1.6), 0, 1)


def _paint_stubble(image: Float, face: FaceMap, amount: float, color: Color, lips: Float) -> Float:
    """Tint the shaven parts of the face: upper lip, chin, jaw and sideburns."""
    top = np.interp(
        face.angle, [0.0, 0.30, 0.55, 0.95, 1.25, 1.45], [5.10, 5.12, 5.16, 5.28, 5.55, 5.70]
    )
    jaw = 1 / (1 + np.exp((face.y - top) / 0.03)) * np.clip((face.y - 4.60) / 0.25, 0, 1)
    jaw *= np.clip((1.60 - face.angle) / 0.45, 0, 1)
    lip = np.clip(1.1 * _spot(face, 0.10, 5.235, 0.12, 0.04), 0, 1) * (face.y < 5.32)
    upper = np.interp(face.x, lips[:, 0], lips[:, 1])
    lip *= np.clip((face.y - upper - 0.008) / 0.015, 0, 1)
    soul = 1 - 0.6 * _spot(face, 0.0, 5.01, 0.20, 0.05)
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


def _paint_age(image: Float, face: FaceMap, amount: float) -> Float:
    texels = np.stack([face.x, face.y], axis=-1)
    waver = 0.004 * noise(face.x.shape, 9, 22)
    for points, depth in _WRINKLES:
        line = np.array(points)
        steps = np.linspace(0, 1, 80)
        curve = interpolate.make_interp_spline(np.linspace(0, 1, len(line)), line, 2)(steps)
        near = (np.abs(texels - curve.mean(axis=0)) < np.ptp(curve, axis=0) / 2 + 0.06).all(axis=-1)
        near &= face.angle < 1.6
        away, at = spatial.cKDTree(curve).query(texels[near])
        above = (texels[near] - curve[at])[:, 1]
        fade = np.sin(np.pi * np.clip(0.02 + 0.96 * steps[at], 0, 1))
        if line[0, 0] == 0.0:  # it continues across the middle
            fade = np.cos(np.pi / 2 * steps[at])
        across = away + waver[near]
        groove = np.exp(-((across / 0.009) ** 2)) + 0.45 * np.exp(-((across / 0.028) ** 2))
        rim = np.exp(-(((away - 0.022) / 0.012) ** 2)) * (above < 0)
        shade = amount * depth * fade
        shaded = image[near] * (1 - shade[:, None] * groove[:, None] * [0.17, 0.24, 0.27])
        image[near] = shaded * (1 + 0.05 * (shade * rim)[:, None])
    spots = np.clip(noise(face.x.shape, 5, 23) - 2.3, 0, 1) * (face.angle > 0.35)
    image = mix(image, (0.60, 0.42, 0.33), 0.55 * amount * spots)
    return image * (1 + 0.012 * amount * noise(face.x.shape, 12, 24)[..., None])


def _paint_lips(image: Float, face: FaceMap, lips: Float, look: Look) -> Float:
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
    below = _spot(face, 0.0, 5.005, 0.15, 0.024) * (1 - inside)
    return np.asarray(image * (1 - 0.30 * below[..., None] * [0.21, 0.34, 0.33]))


def _paint_eye_lines(image: Float, face: FaceMap, lid: Float, lower: Float, width: float) -> Float:
    edge = np.interp(face.x, lid[:, 0], lid[:, 1])
    inside = 1 / (1 + np.exp(-(face.x - lid[0, 0] - 0.01) / 0.008))
    inside *= 1 / (1 + np.exp((face.x - lid[-1, 0] - 0.02) / 0.012))
    height = face.y - edge
    line = np.exp(-((height / (0.011 * width)) ** 2)) * inside
    fold = np.exp(-(((height - 0.052) / 0.010) ** 2)) * inside
    below = np.interp(face.x, lid[:, 0], lower)
    rim = np.exp(-(((face.y - below) / 0.010) ** 2)) * inside
    image = mix(image, (0.52, 0.31, 0.28), 0.45 * rim)
    image = mix(image, (0.16, 0.10, 0.09), 0.80 * line)
    return mix(image, (0.60, 0.41, 0.36), 0.32 * fold)


# a calm, friendly brow, from the nose outward: fraction of its length, height relative to the mean
# of its feature points and half of its breadth, both in dm, and direction of its hairs relative to
# its line, rad
_BROW = np.array(
    [
        [0.00, -0.031, 0.014, 1.20],
        [0.12, -0.026, 0.025, 1.00],
        [0.38, -0.009, 0.026, 0.55],
        [0.68, 0.007, 0.021, 0.25],
        [0.88, 0.001, 0.012, 0.05],
        [1.00, -0.011, 0.004, 0.00],
    ]
)


def _paint_brow(image: Float, face: FaceMap, brow: Float, look: Look) -> Float:
    nose, temple = brow[0, 0] - 0.012, brow[-1, 0] + 0.015
    line = interpolate.PchipInterpolator(_BROW[:, 0], _BROW[:, 1:])
    near = (face.x > nose - 0.05) & (face.x < temple + 0.08) & (face.angle < 1.4)
    near &= np.abs(face.y - brow[:, 1].mean()) < 0.14
    x, y = face.x[near], face.y[near] - brow[:, 1].mean()
    along = (x - nose) / (temple - nose)
    middle, half, _ = line(np.clip(along, 0, 1)).T
    half = half * look.brow_width
    ends = np.clip((along + 0.06) / 0.28, 0, 1) * np.clip((1.03 - along) / 0.15, 0, 1)
    ground = np.clip(1.25 - np.abs(y - middle) / half, 0, 1) * ends
    rng = np.random.default_rng(5)
    hairs = np.zeros(len(x))
    for root in rng.uniform(0.0, 0.97, 230):
        height, reach, lean = line(root)
        reach *= look.brow_width
        off = rng.uniform(-0.9, 0.7) * reach
        slope = float(line(root, 1)[0]) / (temple - nose)
        # hairs lean toward the line from above and below
        turn = np.arctan(slope) + lean * (0.75 - 0.45 * off / reach) + rng.normal(0, 0.10)
        length = rng.uniform(0.035, 0.060) * (0.6 + 0.4 * look.brow_width)
        foot = np.array([nose + root * (temple - nose), height + off])
        away = np.stack([x, y], axis=1) - foot
        t = (away @ [np.cos(turn), np.sin(turn)]) / length
        bend = away @ [-np.sin(turn), np.cos(turn)] + 0.006 * np.clip(t, 0, 1) ** 2
        thin = 0.0026 * np.clip(1.15 - np.clip(t, 0, 1), 0, 1)
        hair = np.clip(1.3 - np.abs(bend) / np.maximum(thin, 1e-4), 0, 1) * (t > 0) * (t < 1)
        hairs = 1 - (1 - hairs) * (1 - 0.62 * hair)
    amount = np.zeros(face.x.shape)
    amount[near] = np.clip(0.34 * ground + 0.85 * hairs * np.clip(ends * 1.6, 0, 1), 0, 0.95)
    return mix(image, look.brow, look.brow_strength * amount)
