"""Parameters of the dynamic visemes, and their file format.

Source: Wang & Cai 2003, section 4: per viseme and FAP alpha, theta_minus, theta_plus, t_o and T,
for closures C and T; per FAP the silence models; one exponent c.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.dynamic_visemes.derived_visemes import append_derived_visemes
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import (
    TRAINED_VISEMES,
    VISEME_INDEX,
    VISEMES,
)
from kouxing.shared.arrays import Doubles, Mask
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_MOUTH_FAPS
from kouxing.shared.files.user_file import check_content, parse_json, read_text

FORMAT = "kouxing viseme parameters 2"
_BUILT_IN = Path(__file__).with_name("parameters.json")
_MAX_BYTES = 1 << 20

PER_VISEME = ("alpha", "theta_minus", "theta_plus", "offset_s", "target", "closes")
PER_SILENCE = (
    "alpha_left", "alpha_right", "theta_left", "theta_right", "offset_left_s", "offset_right_s",
    "neutral",
)  # fmt: skip
_LIMITS = {  # minimum and maximum
    "alpha": (1e-3, 1e3),
    "theta": (1e-2, 1e4),
    "offset": (-0.5, 0.5),
    "target": (-2000.0, 2000.0),
    "neutral": (-2000.0, 2000.0),
    "closes": (0.0, 1.0),
    "level": (-60.0, 30.0),
    "c": (0.5, 3.0),
    "closure_ratio": (20.0, 1e6),
    "closure_reach_s": (0.02, 0.2),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class VisemeParameters:
    """The parameters of the dominance model.

    Viseme arrays have shape (num_visemes, num_mouth_faps), with rows as ``visemes.VISEMES`` and
    columns as ``MOUTH_FAPS``; silence arrays have shape (num_mouth_faps,).
    """

    alpha: Doubles  # dominance at the apex
    theta_minus: Doubles  # decay before the apex, s**-c
    theta_plus: Doubles  # decay after the apex, s**-c
    offset_s: Doubles  # t_o: the FAP's apex minus the acoustic apex, seconds
    target: Doubles  # T, FAP units
    closes: Doubles  # 1 where the closure rule applies, else 0
    level_db: Doubles  # (num_visemes,) usual level relative to the speaker's mean
    alpha_left: Doubles
    alpha_right: Doubles
    theta_left: Doubles  # s**-c
    theta_right: Doubles  # s**-c
    offset_left_s: Doubles  # t_l: from the start of speech, seconds
    offset_right_s: Doubles  # t_r: from the end of speech, seconds
    neutral: Doubles  # T_0, FAP units
    c: float
    closure_ratio: float  # C of Wang & Cai 2003, eq. 7
    closure_reach_s: float  # T of Wang & Cai 2003, eq. 7, seconds
    # columns for each viseme: offset_s, log alpha, theta_minus and theta_plus;
    # (num_visemes, 4, num_mouth_faps)
    dominance: Doubles = dataclasses.field(init=False)
    # silence after speech, then before it, (2, 1, 1, num_mouth_faps)
    silence_log_alpha: Doubles = dataclasses.field(init=False)
    silence_theta: Doubles = dataclasses.field(init=False)
    silence_offset_s: Doubles = dataclasses.field(init=False)
    # (num_visemes,) whether any FAP closes
    any_closes: Mask = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        for name in (field.name for field in fields(self) if field.init):
            value = np.asarray(getattr(self, name), dtype=float)
            shape: tuple[int, ...] = ()
            if name in PER_VISEME:
                shape = (len(VISEMES), NUM_MOUTH_FAPS)
            elif name in PER_SILENCE:
                shape = (NUM_MOUTH_FAPS,)
            elif name == "level_db":
                shape = (len(VISEMES),)
            if value.shape != shape:
                raise UserError(
                    f"viseme parameters: {name} has shape {value.shape}, expected {shape}; "
                    "reinstall kouxing, or train it with 'kouxing train visemes'"
                )
            low, high = _LIMITS[name if name in _LIMITS else name.split("_")[0]]
            if not np.all((value >= low) & (value <= high)):
                raise UserError(
                    f"viseme parameters: {name} is not between {low:g} and {high:g}; "
                    "reinstall kouxing, or train it with 'kouxing train visemes'"
                )
        viseme_columns = (self.offset_s, np.log(self.alpha), self.theta_minus, self.theta_plus)
        object.__setattr__(self, "dominance", np.stack(viseme_columns, axis=1))
        silence_values = {
            "silence_log_alpha": np.log([self.alpha_right, self.alpha_left]),
            "silence_theta": np.array([self.theta_right, self.theta_left]),
            "silence_offset_s": np.array([self.offset_right_s, self.offset_left_s]),
        }
        for name, values in silence_values.items():
            object.__setattr__(self, name, values[:, None, None])
        object.__setattr__(self, "any_closes", (self.closes > 0.0).any(axis=1))


def load_parameters(path: Path | None = None) -> VisemeParameters:
    """Read parameters from a file, by default the built-in parameters.

    Raises ``UserError`` if the file cannot be read, or its contents are invalid.
    """
    data = _read(path)
    with check_content(path or _BUILT_IN, "a file from 'kouxing train visemes'"):
        if data["format"] != FORMAT or data["faps"] != list(MOUTH_FAPS):
            raise ValueError(f"the format is not '{FORMAT}'")
        _clip_names(data)
        arrays = {
            name: np.array([data["visemes"][viseme][name] for viseme in TRAINED_VISEMES], float)
            for name in (*PER_VISEME, "level_db")
        }
        arrays = append_derived_visemes(arrays, VISEME_INDEX)
        arrays |= {name: np.array(data["silence"][name], dtype=float) for name in PER_SILENCE}
        return VisemeParameters(
            **arrays,
            c=float(data["c"]),
            closure_ratio=float(data["closure_ratio"]),
            closure_reach_s=float(data["closure_reach_s"]),
        )


def training_clip_names(path: Path | None) -> frozenset[str]:
    """Return the names of the clips that were used for training or selection."""
    return _clip_names(_read(path))


def _clip_names(data: dict[str, Any]) -> frozenset[str]:
    return frozenset((*data["learned_from"], *data["chosen_with"]))


def _read(path: Path | None) -> dict[str, Any]:
    path = path or _BUILT_IN
    text = read_text(path, _MAX_BYTES)
    with check_content(path, "JSON"):
        data: dict[str, Any] = parse_json(text)
    return data


def fap_columns(faps: Sequence[int]) -> NDArray[np.intp]:
    """Return the columns of FAPs in the parameter arrays."""
    return np.array([MOUTH_FAPS.index(fap) for fap in faps], dtype=np.intp)
