"""The people to build: shapes from MakeHuman's targets, colors and hair."""

from dataclasses import dataclass

from kouxing.training.heads.paint import Look

MorphTargets = tuple[tuple[str, float], ...]


@dataclass(frozen=True, slots=True)
class Person:
    """A head to build."""

    targets: MorphTargets  # MakeHuman targets and their amounts
    face_units: MorphTargets
    look: Look
    skin: str  # names of MakeHuman's parts
    hair: str
    brows: str
    lashes: str = "eyelashes01"
    hair_width: float = 1.0  # factor on the width of MakeHuman's hair
    crown: float = 0.0  # how much wider the hair is between its widest height and its top
    lower_teeth_offset: float = 0.0  # offset of tongue and lower teeth, dm
    upper_teeth_offset: float = 0.0  # dm, so that f meets the teeth, and u and o differ


def _both_sides(name: str, amount: float) -> MorphTargets:
    folder, target = name.split("/")
    return (f"{folder}/l-{target}", amount), (f"{folder}/r-{target}", amount)


# closes the lips, which the plain targets leave apart
_CLOSED_LIPS: MorphTargets = (
    ("mouthPressLeft", 0.12),
    ("mouthPressRight", 0.12),
    ("mouthRollLower", 0.10),
    ("mouthSmileLeft", 0.06),
    ("mouthSmileRight", 0.06),
)

# The head on which zones, texture and hair are laid out. The others share its mesh.
REFERENCE: tuple[MorphTargets, MorphTargets] = (
    (
        ("macrodetails/asian-female-young", 1.0),
        ("head/head-oval", 0.35),
        ("chin/chin-width-decr", 0.25),
        ("nose/nose-scale-horiz-decr", 0.25),
        ("mouth/mouth-upperlip-height-decr", 0.35),
        ("mouth/mouth-lowerlip-height-decr", 0.40),
        *_both_sides("eyes/eye-height2-incr", 0.55),
        *_both_sides("eyes/eye-scale-incr", 0.20),
        *_both_sides("ears/ear-wing-decr", 0.80),
        *_both_sides("ears/ear-scale-decr", 0.40),
        *_both_sides("ears/ear-lobe-decr", 0.60),
    ),
    _CLOSED_LIPS,
)

# raises the corners of the mouth and the cheeks a little
_SMILING: MorphTargets = (
    *_CLOSED_LIPS,
    ("mouthSmileLeft", 0.42),
    ("mouthSmileRight", 0.42),
    ("mouthDimpleLeft", 0.15),
    ("mouthDimpleRight", 0.15),
    ("cheekSquintLeft", 0.25),
    ("cheekSquintRight", 0.25),
)

# also levels the brows and relaxes the lids
_FRIENDLY: MorphTargets = (
    *_SMILING,
    ("browOuterUpLeft", 0.10),
    ("browOuterUpRight", 0.10),
    ("eyeBlinkLeft", 0.14),
    ("eyeBlinkRight", 0.14),
    ("eyeSquintLeft", 0.20),
    ("eyeSquintRight", 0.20),
)

PEOPLE = {
    "woman": Person(
        targets=(*REFERENCE[0], ("head/head-scale-horiz-decr", 0.60),
            ("head/head-invertedtriangular", 0.30), ("mouth/mouth-scale-horiz-decr", 0.20),
            *_both_sides("cheek/cheek-volume-decr", 0.35),
            *_both_sides("eyes/eye-scale-incr", 0.40)),
        face_units=_FRIENDLY,
        look=Look(brow_strength=1.1),
        skin="young_lightskinned_female_diffuse",
        hair="bob02",
        crown=0.15,
        brows="eyebrow001",
        upper_teeth_offset=0.0075,
    ),
    "man": Person(
        targets=(("macrodetails/asian-male-young", 1.0), *_both_sides("ears/ear-wing-decr", 0.50),
            *_both_sides("ears/ear-scale-decr", 0.30), ("mouth/mouth-upperlip-height-decr", 0.40),
            ("mouth/mouth-lowerlip-height-decr", 0.30), *_both_sides("eyes/eye-height2-incr", 0.45),
            *_both_sides("eyes/eye-scale-incr", 0.30), *_both_sides("ears/ear-shape-round", 0.60),
            *_both_sides("cheek/cheek-volume-decr", 0.30), ("mouth/mouth-angles-up", 0.25),
            ("eyebrows/eyebrows-angle-up", 0.40)),
        face_units=_FRIENDLY,
        look=Look(skin=(0.845, 0.660, 0.550), lip=(0.700, 0.440, 0.400), lip_strength=0.75,
            brow_strength=1.0, blush=0.35, stubble=0.55, lash_strength=0.6,
            cloth=(0.27, 0.29, 0.31)),
        skin="young_lightskinned_male_diffuse",
        hair="short04",
        brows="eyebrow012",
        upper_teeth_offset=0.0105,
    ),
    "elder": Person(
        targets=(("macrodetails/asian-male-old", 1.0), *_both_sides("ears/ear-wing-decr", 0.40),
            ("mouth/mouth-angles-up", 0.35), ("eyebrows/eyebrows-trans-up", 0.6),
            *_both_sides("eyes/eye-height2-incr", 0.5), *_both_sides("eyes/eye-scale-incr", 0.20)),
        face_units=_SMILING,
        look=Look(skin=(0.825, 0.645, 0.540), lip=(0.690, 0.450, 0.420), lip_strength=0.50,
            hair=(0.46, 0.455, 0.45), brow=(0.42, 0.39, 0.37), blush=0.35,
            stubble=0.25, lash_strength=0.6, age=0.6, cloth=(0.34, 0.22, 0.20)),
        skin="old_lightskinned_male_diffuse2",
        hair="short04",
        brows="eyebrow012",
        upper_teeth_offset=0.0110,
    ),
    "child": Person(
        targets=(("macrodetails/asian-male-child", 0.65), ("macrodetails/asian-male-baby", 0.35),
            ("mouth/mouth-trans-down", 0.3), *_both_sides("ears/ear-wing-decr", 0.60),
            *_both_sides("ears/ear-scale-decr", 0.40), *_both_sides("eyes/eye-scale-incr", 0.75),
            *_both_sides("eyes/eye-height2-incr", 0.40), ("nose/nose-scale-horiz-decr", 0.50),
            ("mouth/mouth-scale-horiz-decr", 0.30), ("mouth/mouth-upperlip-height-decr", 0.30),
            ("mouth/mouth-lowerlip-height-decr", 0.30), ("neck/neck-scale-horiz-decr", 0.60),
            ("neck/neck-scale-depth-decr", 0.50)),
        face_units=_FRIENDLY,
        look=Look(skin=(0.910, 0.745, 0.650), lip=(0.760, 0.430, 0.405), lip_strength=0.90,
            brow_strength=0.75, blush=1.1, lash_strength=0.8, cloth=(0.62, 0.47, 0.17)),
        skin="young_lightskinned_male_diffuse3",
        hair="short02",
        hair_width=0.94,
        crown=0.04,
        brows="eyebrow001",
        upper_teeth_offset=0.0060,
    ),
    "ada": Person(
        targets=(("macrodetails/african-female-young", 1.0), ("mouth/mouth-trans-down", 0.5),
            ("head/head-oval", 0.40), ("eyebrows/eyebrows-trans-up", 0.5),
            ("mouth/mouth-angles-up", 0.25),
            ("mouth/mouth-upperlip-height-decr", 0.25),
            ("mouth/mouth-lowerlip-height-decr", 0.25), ("nose/nose-scale-horiz-decr", 0.40),
            *_both_sides("eyes/eye-scale-incr", 0.45), *_both_sides("ears/ear-wing-decr", 0.50),
            *_both_sides("ears/ear-scale-decr", 0.30)),
        face_units=_FRIENDLY,
        look=Look(skin=(0.540, 0.380, 0.305), lip=(0.510, 0.275, 0.255), lip_strength=0.80,
            hair=(0.105, 0.085, 0.080), brow=(0.11, 0.08, 0.07), iris=(0.30, 0.17, 0.10),
            brow_strength=0.9, blush=0.7, cloth=(0.74, 0.42, 0.19)),
        skin="young_darkskinned_female_diffuse",
        hair="afro01",
        brows="eyebrow001",
        upper_teeth_offset=0.0120,
        lower_teeth_offset=0.003,
    ),
    "leo": Person(
        targets=(("macrodetails/caucasian-male-young", 1.0), ("eyebrows/eyebrows-trans-up", 0.5),
            ("eyebrows/eyebrows-angle-up", 0.60),
            *_both_sides("eyes/eye-height1-incr", 0.2),
            *_both_sides("eyes/eye-height2-incr", 0.6), ("mouth/mouth-trans-down", 0.3),
            ("mouth/mouth-angles-up", 0.35),
            ("mouth/mouth-upperlip-height-decr", 0.25),
            ("mouth/mouth-lowerlip-height-decr", 0.25), *_both_sides("eyes/eye-scale-incr", 0.30),
            *_both_sides("ears/ear-wing-decr", 0.50), *_both_sides("ears/ear-scale-decr", 0.20)),
        face_units=_FRIENDLY,
        look=Look(skin=(0.880, 0.700, 0.605), lip=(0.700, 0.395, 0.365), lip_strength=0.80,
            hair=(0.370, 0.270, 0.185), brow=(0.33, 0.23, 0.15), iris=(0.42, 0.54, 0.62),
            brow_strength=1.0, blush=0.6, lash_strength=0.6, stubble=0.75,
            cloth=(0.24, 0.36, 0.30)),
        skin="young_lightskinned_male_diffuse3",
        hair="short02",
        brows="eyebrow012",
        lower_teeth_offset=0.008,
        upper_teeth_offset=0.0222,
    ),
    "rosa": Person(
        targets=(("macrodetails/caucasian-female-old", 1.0), ("eyebrows/eyebrows-angle-up", 0.6),
            ("mouth/mouth-trans-down", 0.40),
            *_both_sides("eyes/eye-scale-incr", 0.40), *_both_sides("ears/ear-wing-decr", 0.50)),
        face_units=_FRIENDLY,
        look=Look(skin=(0.890, 0.720, 0.640), lip=(0.700, 0.370, 0.360), lip_strength=0.75,
            hair=(0.62, 0.60, 0.58), brow=(0.48, 0.43, 0.39), iris=(0.40, 0.50, 0.42),
            blush=0.9, age=0.6, cloth=(0.46, 0.33, 0.48)),
        skin="old_lightskinned_female_diffuse2",
        hair="ponytail01",
        brows="eyebrow010",
        lower_teeth_offset=0.015,
        upper_teeth_offset=0.0207,
    ),
    "mika": Person(
        targets=(("macrodetails/asian-female-young", 0.5),
            ("macrodetails/asian-female-child", 0.5), ("eyebrows/eyebrows-trans-up", 0.6),
            ("head/head-invertedtriangular", 0.70), ("chin/chin-width-decr", 0.80),
            ("nose/nose-scale-horiz-decr", 1.0), ("nose/nose-scale-depth-decr", 0.60),
            ("nose/nose-volume-decr", 0.60), ("mouth/mouth-trans-down", 0.25),
            ("mouth/mouth-scale-horiz-decr", 0.30), ("mouth/mouth-upperlip-height-decr", 0.60),
            ("mouth/mouth-lowerlip-height-decr", 0.40), ("neck/neck-scale-horiz-decr", 0.70),
            ("neck/neck-scale-depth-decr", 0.50), *_both_sides("eyes/eye-scale-incr", 2.3),
            *_both_sides("eyes/eye-height2-incr", 1.2), *_both_sides("ears/ear-wing-decr", 0.60),
            *_both_sides("ears/ear-scale-decr", 0.50)),
        face_units=_FRIENDLY,
        look=Look(skin=(0.965, 0.835, 0.770), lip=(0.820, 0.470, 0.455), lip_strength=1.0,
            hair=(0.36, 0.42, 0.66), brow=(0.14, 0.14, 0.28), iris=(0.30, 0.62, 0.80),
            iris_size=1.6, lash_line=1.9, blush=1.1, cloth=(0.66, 0.76, 0.86),
            cel=True),
        skin="young_lightskinned_female_diffuse",
        hair="bob01",
        brows="eyebrow008",
        upper_teeth_offset=0.0165,
    ),
}  # fmt: skip
