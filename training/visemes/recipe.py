"""From clips of real lips to a file with viseme parameters."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from kouxing.corpora.lip_clips import LipClip, label_clip, no_clip_error, read_clips
from kouxing.services.mouth_profiles.lip_tracks import LEVEL_STEP_S, measure_levels
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.synthesizer.lips.dynamic_visemes.blending import blend
from kouxing.services.synthesizer.lips.dynamic_visemes.initial_parameters import initial_parameters
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import (
    FORMAT,
    PER_SILENCE,
    PER_VISEME,
    VisemeParameters,
    fap_columns,
)
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import build_timeline
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import (
    TRAINED_VISEMES,
    VISEME_INDEX,
    VISEMES,
)
from kouxing.shared.arrays import Doubles
from kouxing.shared.command.terminal import write_text
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import PhoneInventory
from kouxing.training.visemes.fit import collect_frames, fit_parameters

_LEVEL_RIDGE = 3.0  # weight of the initial levels, phones
_SPOKEN_DB = 25.0  # audio this far below the loudest is not speech
_CLOSURE_REACHES_S = (0.05, 0.06, 0.07, 0.08, 0.1)  # shorter closures are hardly visible
_CLOSURE_WINDOW_S, _CLOSURE_NEIGHBORS_S = 0.12, 1.0
# The fit uses exact phone onsets, but live phones arrive late. Of 0, 10, 15, 20 and 40 ms, this
# lead removes most of the lag on clips of the part "choice" at a delay of 160 ms, and keeps long
# vowels open.
_LEAD_S = 0.015
_SOURCE = "start and tongue: targets of Crystal.TTVS (Tsinghua University), Apache-2.0"


def measure_viseme_levels(
    clips: Sequence[LipClip], labels: Sequence[list[Phone]], inventory: PhoneInventory
) -> Doubles:
    """Measure the level of each viseme relative to its speaker's mean, dB, (num_visemes,)."""
    start = initial_parameters().level_db
    total, count = _LEVEL_RIDGE * start, np.full(len(VISEMES), _LEVEL_RIDGE)
    for clip, phones in zip(clips, labels, strict=True):
        time_s, level = np.array(measure_levels(clip.samples)).T
        timeline = build_timeline(phones, inventory)
        spoken_db = level[level > np.percentile(level, 95.0) - _SPOKEN_DB]
        for viseme, start_s, end_s in zip(
            timeline.viseme, timeline.apex_start_s, timeline.apex_end_s, strict=True
        ):
            inside = (time_s > start_s - LEVEL_STEP_S) & (time_s < end_s + LEVEL_STEP_S)
            if inside.any():
                quieter_db = float(np.mean(level[inside] - spoken_db.mean()))
                if quieter_db > -_SPOKEN_DB:  # a lower one is a pause
                    total[viseme] += quieter_db
                    count[viseme] += 1.0
    return np.asarray(total / count)


def closure_reach(
    parameters: VisemeParameters,
    clips: Sequence[LipClip],
    labels: Sequence[list[Phone]],
    inventory: PhoneInventory,
) -> float:
    """Find the T of the closure rule that best fits the lips around b p m, seconds.

    C cannot be estimated, because all values above 20 give the same closed lips.
    """
    lips = fap_columns((4, 5))

    def loss(reach_s: float) -> float:
        error = 0.0
        for clip, phones in zip(clips, labels, strict=True):
            timeline = build_timeline(phones, inventory)
            rows = np.flatnonzero(timeline.viseme == VISEME_INDEX["b"])
            for row in rows:
                apex_s = timeline.apex_start_s[row]
                frames = np.flatnonzero(np.abs(clip.time_s - apex_s) < _CLOSURE_WINDOW_S)
                near = np.abs(timeline.apex_start_s - apex_s) < _CLOSURE_NEIGHBORS_S
                curve = blend(
                    replace(parameters, closure_reach_s=reach_s),
                    timeline.select(near),
                    clip.time_s[frames],
                )
                error += float(np.nansum((curve[:, lips] - clip.faps[frames][:, lips]) ** 2))
        return error

    return min(_CLOSURE_REACHES_S, key=loss)


def train_visemes(folder: Path, output: Path, *, any_license: bool) -> None:
    """Train viseme parameters on the training clips of a folder.

    Raises ``UserError`` if no clip may be used, or the file cannot be written.
    """
    clips = read_clips(folder, any_license=any_license)
    used = [clip for clip in clips if clip.split == "train"]
    if not used:
        raise no_clip_error(folder)
    model = load_model()
    inventory = model.inventory
    labels = [label_clip(model, clip) for clip in used]
    parameters = fit_parameters(collect_frames(used, labels, inventory))
    parameters = replace(parameters, level_db=measure_viseme_levels(used, labels, inventory))
    reach_s = closure_reach(parameters, used, labels, inventory)
    parameters = replace(
        parameters,
        closure_reach_s=reach_s,
        offset_s=parameters.offset_s - _LEAD_S,
        offset_left_s=parameters.offset_left_s - _LEAD_S,
        offset_right_s=parameters.offset_right_s - _LEAD_S,
    )
    licenses = "; ".join(sorted({clip.license for clip in used}))
    text = format_parameters(
        parameters,
        f"{_SOURCE}; the rest learned from clips under: {licenses}",
        learned_from=[clip.name for clip in used],
        chosen_with=[clip.name for clip in clips if clip.split == "choice"],
    )
    write_text(output, text)


def format_parameters(
    parameters: VisemeParameters,
    source: str,
    *,
    learned_from: Sequence[str],
    chosen_with: Sequence[str],
) -> str:
    """Return parameters as JSON, one line per viseme and array.

    ``source`` describes their origin. ``learned_from`` and ``chosen_with`` are names of clips
    that a fair evaluation must exclude.
    """

    def line(name: str, values: Doubles) -> str:
        # seven digits are precise enough and equal on all machines
        return f"{json.dumps(name)}: [{', '.join(f'{value:.7g}' for value in values)}]"

    visemes = ",\n".join(
        f"  {json.dumps(viseme)}: {{\n"
        + ",\n".join(f"   {line(name, getattr(parameters, name)[i])}" for name in PER_VISEME)
        + f',\n   "level_db": {parameters.level_db[i]:.4g}'
        + "\n  }"
        for i, viseme in enumerate(TRAINED_VISEMES)
    )
    silence = ",\n".join(f"  {line(name, getattr(parameters, name))}" for name in PER_SILENCE)
    head = "".join(
        f" {json.dumps(name)}: {json.dumps(value)},\n"
        for name, value in (
            ("format", FORMAT),
            ("source", source),
            ("learned_from", list(learned_from)),
            ("chosen_with", list(chosen_with)),
            ("c", parameters.c),
            ("closure_ratio", parameters.closure_ratio),
            ("closure_reach_s", parameters.closure_reach_s),
            ("faps", list(MOUTH_FAPS)),
        )
    )
    return f'{{\n{head} "silence": {{\n{silence}\n }},\n "visemes": {{\n{visemes}\n }}\n}}\n'
