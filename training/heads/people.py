"""The people to build: shapes from MakeHuman's targets, colors and hair."""

from dataclasses import dataclass

from kouxing.training.heads.hair_styles import Bob, Crop, Hair
from kouxing.training.heads.paint import Look

Shape = tuple[tuple[str, float], ...]


@dataclass(frozen=True, slots=True)
class Person:
    """A head to build."""

    targets: Shape  # MakeHuman targets and their amounts
    face_units: Shape
    look: Look
    hair: Hair
    lashes: float = 1.0  # length
    raised: float = 0.0  # offset of tongue and lower teeth, dm


def _both(name: str, amount: float) -> Shape:
    folder, target = name.split("/")
    return (f"{folder}/l-{target}", amount), (f"{folder}/r-{target}", amount)


# closes the lips, which the plain targets leave apart
_REST: Shape = (
    ("mouthPressLeft", 0.12),
    ("mouthPressRight", 0.12),
    ("mouthRollLower", 0.10),
    ("mouthSmileLeft", 0.06),
    ("mouthSmileRight", 0.06),
)

# The head on which zones, texture and hair are laid out. The others share its mesh.
REFERENCE: tuple[Shape, Shape] = (
    (
        ("macrodetails/asian-female-young", 1.0),
        ("head/head-oval", 0.35),
        ("chin/chin-width-decr", 0.25),
        ("nose/nose-scale-horiz-decr", 0.25),
        ("mouth/mouth-upperlip-height-decr", 0.35),
        ("mouth/mouth-lowerlip-height-decr", 0.40),
        *_both("eyes/eye-height2-incr", 0.55),
        *_both("eyes/eye-scale-incr", 0.20),
        *_both("ears/ear-wing-decr", 0.80),
        *_both("ears/ear-scale-decr", 0.40),
        *_both("ears/ear-lobe-decr", 0.60),
    ),
    _REST,
)

# raises the corners of the mouth and the cheeks a little
_FRIENDLY: Shape = (
    *_REST,
    ("mouthSmileLeft", 0.30),
    ("mouthSmileRight", 0.30),
    ("cheekSquintLeft", 0.15),
    ("cheekSquintRight", 0.15),
)

_NAPE = (
    (0.70, 5.92, 0.38), (0.69, 5.82, 0.29), (0.68, 5.60, 0.22), (0.61, 5.38, 0.16),
    (0.47, 5.22, 0.06), (0.28, 5.12, -0.02), (0.0, 5.09, -0.06),
)  # fmt: skip
_SHORT = (
    (0.0, 6.41, 1.20), (0.12, 6.42, 1.18), (0.26, 6.45, 1.12), (0.40, 6.42, 1.02),
    (0.50, 6.29, 0.95), (0.585, 6.12, 0.87), (0.64, 5.96, 0.79), (0.672, 5.80, 0.755),
    (0.68, 5.70, 0.72), (0.69, 5.70, 0.63), (0.70, 5.84, 0.57), (0.70, 5.91, 0.48), *_NAPE,
)  # fmt: skip
_RECEDING = (
    (0.0, 6.50, 1.14), (0.16, 6.52, 1.10), (0.32, 6.53, 0.96), (0.47, 6.38, 0.84),
    (0.585, 6.12, 0.84), (0.64, 5.96, 0.78), (0.672, 5.80, 0.745), (0.68, 5.70, 0.71),
    *_SHORT[9:],
)  # fmt: skip
_BOWL = (
    (0.0, 6.18, 1.28), (0.20, 6.18, 1.25), (0.38, 6.16, 1.14), (0.52, 6.10, 1.01),
    (0.61, 5.98, 0.88), (0.66, 5.84, 0.74), (0.69, 5.80, 0.62), (0.70, 5.84, 0.48),
    (0.70, 5.80, 0.34), (0.69, 5.66, 0.25), (0.66, 5.48, 0.20), (0.56, 5.32, 0.10),
    (0.30, 5.18, -0.02), (0.0, 5.15, -0.06),
)  # fmt: skip

PEOPLE = {
    "woman": Person(
        targets=(*REFERENCE[0], ("head/head-scale-horiz-decr", 0.40),
            ("head/head-invertedtriangular", 0.30), *_both("cheek/cheek-volume-decr", 0.35),
            *_both("eyes/eye-scale-incr", 0.40)),
        face_units=_FRIENDLY,
        look=Look(brow_width=0.85),
        hair=Bob(),
    ),
    "man": Person(
        targets=(("macrodetails/asian-male-young", 1.0), *_both("ears/ear-wing-decr", 0.50),
            *_both("ears/ear-scale-decr", 0.30), ("mouth/mouth-upperlip-height-decr", 0.40),
            ("mouth/mouth-lowerlip-height-decr", 0.30), *_both("eyes/eye-height2-incr", 0.45),
            *_both("eyes/eye-scale-incr", 0.30), *_both("ears/ear-shape-round", 0.60),
            *_both("cheek/cheek-volume-decr", 0.30)),
        face_units=_FRIENDLY,
        look=Look(skin=(0.845, 0.660, 0.550), lip=(0.700, 0.440, 0.400), lip_strength=0.60,
            brow_width=1.25, brow_strength=1.0, blush=0.35, stubble=0.55,
            cloth=(0.27, 0.29, 0.31)),
        hair=Crop(_SHORT, (5.3, 5.7, 6.1, 6.4, 6.6, 6.8), (0.015, 0.02, 0.03, 0.05, 0.09, 0.12),
            combed_back=0.9, aside=0.5, lift=0.045),
        lashes=0.55,
    ),
    "elder": Person(
        targets=(("macrodetails/asian-male-old", 1.0), *_both("ears/ear-wing-decr", 0.40),
            ("mouth/mouth-angles-up", 0.45)),
        face_units=_FRIENDLY,
        look=Look(skin=(0.825, 0.645, 0.540), lip=(0.690, 0.450, 0.420), lip_strength=0.50,
            hair=(0.56, 0.55, 0.54), brow=(0.42, 0.39, 0.37), brow_width=1.25, blush=0.35,
            stubble=0.25, age=1.0, cloth=(0.34, 0.22, 0.20)),
        hair=Crop(_RECEDING, (5.3, 5.7, 6.1, 6.4, 6.6, 6.8),
            (0.015, 0.02, 0.03, 0.04, 0.06, 0.07), combed_back=1.0, aside=0.2, lift=0.03),
        lashes=0.50,
    ),
    "child": Person(
        targets=(("macrodetails/asian-male-child", 0.65), ("macrodetails/asian-male-baby", 0.35),
            ("mouth/mouth-trans-down", 0.3), *_both("ears/ear-wing-decr", 0.60),
            *_both("ears/ear-scale-decr", 0.40), *_both("eyes/eye-scale-incr", 0.50),
            *_both("eyes/eye-height2-incr", 0.40), ("nose/nose-scale-horiz-decr", 0.50),
            ("mouth/mouth-scale-horiz-decr", 0.30), ("mouth/mouth-upperlip-height-decr", 0.30),
            ("mouth/mouth-lowerlip-height-decr", 0.30), ("neck/neck-scale-horiz-decr", 0.60),
            ("neck/neck-scale-depth-decr", 0.50)),
        face_units=_FRIENDLY,
        look=Look(skin=(0.910, 0.745, 0.650), lip=(0.750, 0.420, 0.400), lip_strength=0.85,
            brow_width=0.80, brow_strength=0.75, blush=1.25, cloth=(0.62, 0.47, 0.17)),
        hair=Crop(_BOWL, (5.3, 5.7, 6.1, 6.45, 6.75), (0.05, 0.08, 0.09, 0.10, 0.10), ends=0.45,
            aside=0.25, length=0.6, lift=0.04),
        lashes=0.80,
    ),
    "ada": Person(
        targets=(("macrodetails/african-female-young", 1.0), ("mouth/mouth-trans-down", 0.5),
            ("head/head-oval", 0.40), ("mouth/mouth-upperlip-height-decr", 0.25),
            ("mouth/mouth-lowerlip-height-decr", 0.25), ("nose/nose-scale-horiz-decr", 0.40),
            *_both("eyes/eye-scale-incr", 0.45), *_both("ears/ear-wing-decr", 0.50),
            *_both("ears/ear-scale-decr", 0.30)),
        face_units=_FRIENDLY,
        look=Look(skin=(0.540, 0.380, 0.305), lip=(0.560, 0.230, 0.225), lip_strength=0.85,
            hair=(0.105, 0.085, 0.080), brow=(0.11, 0.08, 0.07), iris=(0.30, 0.17, 0.10),
            blush=0.7, cloth=(0.74, 0.42, 0.19)),
        hair=Crop(_SHORT, (5.3, 5.7, 6.1, 6.4, 6.6, 6.8), (0.015, 0.02, 0.02, 0.025, 0.03, 0.03),
            combed_back=4.0, locks=200, lift=0.015, bun=0.36),
        raised=0.003,
    ),
    "leo": Person(
        targets=(("macrodetails/caucasian-male-young", 1.0), ("eyebrows/eyebrows-trans-up", 0.5),
            ("mouth/mouth-angles-up", 0.35), *_both("eyes/eye-height1-incr", 0.2),
            *_both("eyes/eye-height2-incr", 0.6), ("mouth/mouth-trans-down", 0.3),
            ("mouth/mouth-upperlip-height-decr", 0.25),
            ("mouth/mouth-lowerlip-height-decr", 0.25), *_both("eyes/eye-scale-incr", 0.30),
            *_both("ears/ear-wing-decr", 0.50), *_both("ears/ear-scale-decr", 0.20)),
        face_units=_FRIENDLY,
        look=Look(skin=(0.880, 0.700, 0.605), lip=(0.720, 0.420, 0.385), lip_strength=0.70,
            hair=(0.40, 0.275, 0.170), brow=(0.30, 0.20, 0.12), iris=(0.42, 0.54, 0.62),
            brow_width=1.2, blush=0.6, stubble=0.75, cloth=(0.24, 0.36, 0.30)),
        hair=Crop(_SHORT, (5.3, 5.7, 6.1, 6.4, 6.6, 6.8), (0.015, 0.02, 0.035, 0.07, 0.12, 0.15),
            combed_back=1.0, aside=-0.9, length=0.55, width=0.12, lift=0.06),
        lashes=0.55,
        raised=0.012,
    ),
    "rosa": Person(
        targets=(("macrodetails/caucasian-female-old", 1.0), ("eyebrows/eyebrows-angle-up", 0.6),
            ("mouth/mouth-trans-down", 0.40), ("mouth/mouth-angles-up", 0.35),
            *_both("eyes/eye-scale-incr", 0.40), *_both("ears/ear-wing-decr", 0.50)),
        face_units=_FRIENDLY,
        look=Look(skin=(0.890, 0.720, 0.640), lip=(0.700, 0.370, 0.360), lip_strength=0.75,
            hair=(0.74, 0.72, 0.70), brow=(0.50, 0.45, 0.41), iris=(0.40, 0.50, 0.42),
            brow_width=0.9, blush=0.9, age=0.6, cloth=(0.46, 0.33, 0.48)),
        hair=Bob(parting=-20.0, length=0.72, turn_in=0.24),
        lashes=0.70,
        raised=0.015,
    ),
    "mika": Person(
        targets=(("macrodetails/asian-female-young", 0.5),
            ("macrodetails/asian-female-child", 0.5), ("eyebrows/eyebrows-trans-up", 0.6),
            ("head/head-invertedtriangular", 0.70), ("chin/chin-width-decr", 0.80),
            ("nose/nose-scale-horiz-decr", 1.0), ("nose/nose-scale-depth-decr", 0.60),
            ("nose/nose-volume-decr", 0.60), ("mouth/mouth-trans-down", 0.25),
            ("mouth/mouth-scale-horiz-decr", 0.30), ("mouth/mouth-upperlip-height-decr", 0.60),
            ("mouth/mouth-lowerlip-height-decr", 0.40), ("neck/neck-scale-horiz-decr", 0.70),
            ("neck/neck-scale-depth-decr", 0.50), *_both("eyes/eye-scale-incr", 2.3),
            *_both("eyes/eye-height2-incr", 1.2), *_both("ears/ear-wing-decr", 0.60),
            *_both("ears/ear-scale-decr", 0.50)),
        face_units=_FRIENDLY,
        look=Look(skin=(0.965, 0.835, 0.770), lip=(0.850, 0.520, 0.500), lip_strength=0.75,
            hair=(0.36, 0.42, 0.66), brow=(0.26, 0.29, 0.48), iris=(0.30, 0.62, 0.80),
            iris_size=1.6, lash_line=1.9, brow_width=0.60, blush=1.1, cloth=(0.66, 0.76, 0.86),
            cel=True),
        hair=Crop(_BOWL, (5.3, 5.7, 6.1, 6.45, 6.75), (0.09, 0.12, 0.13, 0.15, 0.15), ends=0.55,
            aside=0.3, locks=140, length=0.85, width=0.26, lift=0.08),
        lashes=1.0,
    ),
}  # fmt: skip
