"""The mouths of other programs: as shipped and through a linear map, each at its best delay.

A frame for time t of a face with delay d uses the rows of a table up to t + d. The correlation of
the opening on the training clips selects the delay. Without tables of training clips, there is no
linear map, and the delay is 0.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from kouxing.corpora.lip_clips import LipClip
from kouxing.evaluation.lips.agreement import moments
from kouxing.evaluation.lips.curve_tables import CurveTable, fap_conversion, read_tables
from kouxing.evaluation.lips.linear_map import fit_map
from kouxing.evaluation.lips.live_faces import FRAME_RATE_HZ
from kouxing.evaluation.lips.mouths import Mouth, clip_mouth, predicted_mouth
from kouxing.shared.arrays import Doubles
from kouxing.shared.clock import MEDIA_RATE_HZ

MouthFunction = Callable[[LipClip], Mouth]
FapsFunction = Callable[[LipClip, Doubles], Doubles]  # clip, times (n,) in s; FAPs (n, 68)

_DELAYS_S = tuple(step / 50.0 for step in range(16))  # 0 to 0.3 s
_TAIL_S = 0.5  # frames after the end of a clip's audio


def load_programs(
    folders: Sequence[Path], held_out: Sequence[LipClip], training: Sequence[LipClip]
) -> dict[str, MouthFunction]:
    """Load the mouths of other programs from folders of tables; return them by title.

    Raises ``UserError`` if a table is missing or cannot be used (see ``read_tables``).
    """
    mouths: dict[str, MouthFunction] = {}
    for folder in folders:
        tables = read_tables(folder, held_out, training)
        fitting = [clip for clip in training if clip.name in tables and clip.is_in_sync]
        mouths |= _mouths_of(folder, tables, fitting)
    return mouths


def load_program_faps(folder: Path, clips: Sequence[LipClip]) -> FapsFunction:
    """Load a program's curves as shipped, at the delay that agrees best with the given clips.

    Raises ``UserError`` if a table is missing or cannot be used (see ``read_tables``).
    """
    faps_of, _ = _program_faps(folder, read_tables(folder, clips, ()), clips)
    return faps_of


def _program_faps(
    folder: Path, tables: Mapping[str, CurveTable], fitting: Sequence[LipClip]
) -> tuple[FapsFunction, float]:
    """Return the FAPs of a face, and its delay, seconds."""
    shipped = fap_conversion(folder, [*tables.values()])

    def faps(clip: LipClip, time_s: Doubles, delay_s: float) -> Doubles:
        return shipped.faps(tables[clip.name].at(time_s + delay_s))

    reals = [clip_mouth(clip) for clip in fitting]

    def agreement(delay_s: float) -> float:
        pairs = [
            (predicted_mouth(faps(clip, _frames_s(clip), delay_s)), real)
            for clip, real in zip(fitting, reals, strict=True)
        ]
        return moments(pairs, "opening").correlation or 0.0

    delay_s = max(_DELAYS_S, key=agreement) if fitting else 0.0
    return partial(faps, delay_s=delay_s), delay_s


def _mouths_of(
    folder: Path, tables: Mapping[str, CurveTable], fitting: Sequence[LipClip]
) -> dict[str, MouthFunction]:
    faps_of, delay_s = _program_faps(folder, tables, fitting)
    title = f"{folder.name}, {1e3 * delay_s:.0f} ms"
    mouths: dict[str, MouthFunction] = {
        title: lambda clip: predicted_mouth(faps_of(clip, _frames_s(clip)))
    }
    if fitting:
        linear = fit_map(fitting, tables, _DELAYS_S[::2])
        title = f"{folder.name}, fitted, {1e3 * linear.delay_s:.0f} ms"
        mouths[title] = lambda clip: predicted_mouth(
            linear.faps(tables[clip.name], _frames_s(clip))
        )
    return mouths


def _frames_s(clip: LipClip) -> Doubles:
    duration_s = max(float(clip.time_s[-1]), len(clip.samples) / MEDIA_RATE_HZ)
    return np.arange(int((duration_s + _TAIL_S) * FRAME_RATE_HZ)) / FRAME_RATE_HZ
