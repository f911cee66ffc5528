"""Writes the parameters of the dynamic visemes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import (
    FORMAT,
    PER_SILENCE,
    PER_VISEME,
    VisemeParameters,
)
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import VISEMES
from kouxing.shared.face.faps import MOUTH_FAPS


def save_parameters(
    parameters: VisemeParameters,
    path: Path,
    source: str,
    *,
    learnt_from: Sequence[str] = (),
    chosen_with: Sequence[str] = (),
) -> None:
    """Write parameters as JSON, one line per viseme and array.

    ``source`` describes their origin. ``learnt_from`` and ``chosen_with`` are names of clips that a
    fair evaluation must exclude.
    """

    def line(name: str, values: NDArray[np.float64]) -> str:
        # seven digits are precise enough and equal on all machines
        return f"{json.dumps(name)}: [{', '.join(f'{value:.7g}' for value in values)}]"

    visemes = ",\n".join(
        f"  {json.dumps(viseme)}: {{\n"
        + ",\n".join(f"   {line(name, getattr(parameters, name)[i])}" for name in PER_VISEME)
        + f',\n   "level_db": {parameters.level_db[i]:.4g}'
        + "\n  }"
        for i, viseme in enumerate(VISEMES)
    )
    silence = ",\n".join(f"  {line(name, getattr(parameters, name))}" for name in PER_SILENCE)
    head = "".join(
        f" {json.dumps(name)}: {json.dumps(value)},\n"
        for name, value in (
            ("format", FORMAT),
            ("source", source),
            ("learnt_from", list(learnt_from)),
            ("chosen_with", list(chosen_with)),
            ("c", parameters.c),
            ("closure_ratio", parameters.closure_ratio),
            ("closure_reach_s", parameters.closure_reach_s),
            ("faps", list(MOUTH_FAPS)),
        )
    )
    path.write_text(
        f'{{\n{head} "silence": {{\n{silence}\n }},\n "visemes": {{\n{visemes}\n }}\n}}\n',
        encoding="utf-8",
    )
