"""Who is built: shapes out of MakeHuman's targets, colours and hair."""

from __future__ import annotations

from dataclasses import dataclass

from training.heads.hair import Bob, Crop, Hair
from training.heads.paint import Look

Shape = tuple[tuple[str, float], ...]


@dataclass(frozen=True, slots=True)
class Person:
    """A head to build."""

    targets: Shape  # of MakeHuman and how much of each
    face_units: Shape
    look: Look
    hair: Hair
    lashes: float = 1.0  # length


def _both(name: str, amount: float) -> Shape:
    """Apply a target to the left and to the right."""
    folder, target = name.split("/")
    return (f"{folder}/l-{target}", amount), (f"{folder}/r-{target}", amount)


# the lips closed, which the plain targets leave apart, and a friendly look
_REST: Shape = (
    ("mouthPressLeft", 0.12),
    ("mouthPressRight", 0.12),
    ("mouthRollLower", 0.10),
    ("mouthSmileLeft", 0.06),
    ("mouthSmileRight", 0.06),
)

# The head on which zones, texture and hair are laid out; the others share its mesh, vertex by
# vertex, and take all of that over.
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

_NAPE = (
    (0.70, 5.99, 0.38), (0.69, 5.84, 0.27), (0.68, 5.60, 0.22), (0.61, 5.38, 0.16),
    (0.47, 5.22, 0.06), (0.28, 5.12, -0.02), (0.0, 5.09, -0.06),
)  # fmt: skip
_SHORT = (
    (0.0, 6.42, 1.20), (0.22, 6.44, 1.14), (0.40, 6.39, 1.02), (0.50, 6.27, 0.95),
    (0.585, 6.12, 0.87), (0.64, 5.96, 0.79), (0.672, 5.78, 0.745), (0.68, 5.64, 0.70),
    (0.69, 5.64, 0.63), (0.70, 5.84, 0.57), (0.70, 5.97, 0.48), *_NAPE,
)  # fmt: skip
_RECEDING = (
    (0.0, 6.50, 1.14), (0.16, 6.52, 1.10), (0.32, 6.53, 0.96), (0.47, 6.38, 0.84),
    (0.585, 6.12, 0.84), (0.64, 5.96, 0.78), (0.672, 5.78, 0.735), (0.68, 5.66, 0.70),
    *_SHORT[8:],
)  # fmt: skip
_BOWL = (
    (0.0, 6.18, 1.28), (0.20, 6.18, 1.25), (0.38, 6.16, 1.14), (0.52, 6.10, 1.01),
    (0.61, 5.98, 0.88), (0.66, 5.84, 0.74), (0.69, 5.80, 0.62), (0.70, 5.84, 0.48),
    (0.70, 5.80, 0.34), (0.69, 5.66, 0.25), (0.66, 5.48, 0.20), (0.56, 5.32, 0.10),
    (0.30, 5.18, -0.02), (0.0, 5.15, -0.06),
)  # fmt: skip

PEOPLE = {
    "woman": Person(
        targets=(
            *REFERENCE[0],
            ("head/head-scale-horiz-decr", 0.25),
            *_both("cheek/cheek-volume-decr", 0.35),
        ),
        face_units=REFERENCE[1],
        look=Look(),
        hair=Bob(),
    ),
    "man": Person(
        targets=(
            ("macrodetails/asian-male-young", 1.0),
            *_both("ears/ear-wing-decr", 0.50),
            *_both("ears/ear-scale-decr", 0.30),
            ("mouth/mouth-upperlip-height-decr", 0.40),
            ("mouth/mouth-lowerlip-height-decr", 0.30),
            *_both("eyes/eye-height2-incr", 0.35),
            *_both("cheek/cheek-volume-decr", 0.30),
        ),
        face_units=_REST,
        look=Look(
            skin=(0.845, 0.660, 0.550),
            lip=(0.700, 0.440, 0.400),
            lip_strength=0.60,
            brow_width=1.35,
            brow_strength=1.15,
            blush=0.35,
            stubble=0.55,
            cloth=(0.27, 0.29, 0.31),
        ),
        hair=Crop(_SHORT, (5.3, 5.7, 6.1, 6.45, 6.75), (0.02, 0.025, 0.045, 0.09, 0.08)),
        lashes=0.55,
    ),
    "elder": Person(
        targets=(
            ("macrodetails/asian-male-old", 1.0),
            *_both("ears/ear-wing-decr", 0.40),
            ("mouth/mouth-angles-up", 0.45),
        ),
        face_units=_REST,
        look=Look(
            skin=(0.825, 0.645, 0.540),
            lip=(0.690, 0.450, 0.420),
            lip_strength=0.50,
            hair=(0.56, 0.55, 0.54),
            brow=(0.42, 0.39, 0.37),
            brow_width=1.25,
            blush=0.35,
            stubble=0.25,
            age=1.0,
            cloth=(0.34, 0.22, 0.20),
        ),
        hair=Crop(_RECEDING, (5.3, 5.7, 6.1, 6.45, 6.75), (0.02, 0.025, 0.04, 0.06, 0.05)),
        lashes=0.50,
    ),
    "child": Person(
        targets=(
            ("macrodetails/asian-male-child", 0.65),
            ("macrodetails/asian-male-baby", 0.35),
            *_both("ears/ear-wing-decr", 0.60),
            *_both("ears/ear-scale-decr", 0.40),
            *_both("eyes/eye-scale-incr", 0.50),
            *_both("eyes/eye-height2-incr", 0.40),
            ("nose/nose-scale-horiz-decr", 0.50),
            ("mouth/mouth-scale-horiz-decr", 0.30),
            ("mouth/mouth-upperlip-height-decr", 0.30),
            ("mouth/mouth-lowerlip-height-decr", 0.30),
            ("neck/neck-scale-horiz-decr", 0.60),
            ("neck/neck-scale-depth-decr", 0.50),
        ),
        face_units=_REST,
        look=Look(
            skin=(0.910, 0.745, 0.650),
            lip=(0.760, 0.460, 0.430),
            lip_strength=0.65,
            brow_width=0.80,
            brow_strength=0.75,
            blush=1.25,
            cloth=(0.62, 0.47, 0.17),
        ),
        hair=Crop(_BOWL, (5.3, 5.7, 6.1, 6.45, 6.75), (0.05, 0.08, 0.10, 0.10, 0.06), ends=0.45),
        lashes=0.80,
    ),
}
