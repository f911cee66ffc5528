"""Clips with tracked lips, their phones, and their times of speech."""

import textwrap
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np

from kouxing.corpora.lip_clips import LipClip, read_clips, training_clips
from kouxing.evaluation.lips.curves import is_near
from kouxing.evaluation.lips.mouths import CURVES, Mouth, real_faps
from kouxing.services.mouth_profiles.lip_tracks import LEVEL_STEP_S, measure_levels
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import training_clip_names
from kouxing.shared.arrays import Doubles, Mask
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.command.terminal import plural, print_message
from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import Phone, SpeechChange

PAUSE = "pause"
_SPEECH_RANGE_DB, _SPEECH_MARGIN_S = 30.0, 0.1
_MIN_PAUSE_S = 0.3
_POWER_STEP_S = 0.01
_MAX_NAMES_LENGTH = 200  # characters in a message
_LABIAL = "b"  # viseme of b p m


@dataclass(frozen=True, kw_only=True)
class Reference:
    """A clip with its real mouth and the recognizer's output for its undisturbed audio."""

    clip: LipClip
    mouth: Mouth
    phones: Sequence[Phone]  # aligned with the text, or recognized
    voice: Sequence[SpeechChange]  # the recognizer's voice activity
    visemes: Mapping[str, Sequence[tuple[str, float]]]  # by phone, with fractions of it

    @cached_property
    def loud_s(self) -> Doubles:
        """When the sound is less than 30 dB below the loudest, seconds."""
        end_s, level_db = np.array(measure_levels(self.clip.samples)).reshape(-1, 2).T
        if not len(end_s):
            return end_s
        is_loud = level_db > np.percentile(level_db, 95) - _SPEECH_RANGE_DB
        return np.asarray(end_s[is_loud] - LEVEL_STEP_S / 2.0)

    @property
    def rms(self) -> float:
        """Root mean square of the samples."""
        return float(np.sqrt(np.mean(np.square(self.clip.samples, dtype=float))))

    def is_speech(self, time_s: Doubles) -> Mask:
        """Whether there is speech at the given times.

        Voice activity is on, and a loud sound is within 0.1 s. Voice activity alone spans pauses of
        half a second, and the level mistakes noise for speech.
        """
        after = np.searchsorted([change.time_s for change in self.voice], time_s, side="right")
        is_active = np.array([False, *(change.active for change in self.voice)])[after]
        return np.asarray(is_active & is_near(time_s, self.loud_s, _SPEECH_MARGIN_S))

    def pauses(self) -> list[tuple[float, float]]:
        """Return start and end of each silence of at least 0.3 s after a sound, seconds."""
        if not len(self.loud_s):
            return []
        sounds_s = [*self.loud_s, self.clip.time_s[-1] + LEVEL_STEP_S / 2.0]
        edges = ((a + LEVEL_STEP_S / 2.0, b - LEVEL_STEP_S / 2.0) for a, b in pairwise(sounds_s))
        return [(start, end) for start, end in edges if end - start >= _MIN_PAUSE_S]

    def viseme_at(self, time_s: float) -> str:
        """Return the viseme at a time, or ``PAUSE``."""
        for phone in self.phones:
            fraction = (time_s - phone.onset_s) / max(phone.duration_s, 1e-9)
            if 0.0 <= fraction < 1.0:
                for viseme, extent in self.visemes[phone.symbol]:
                    if fraction < extent + 1e-9:
                        return PAUSE if viseme == "rest" else viseme
                    fraction -= extent
        return PAUSE

    def labials(self) -> list[Phone]:
        """Return the phones b p m."""
        return [phone for phone in self.phones if self.visemes[phone.symbol][0][0] == _LABIAL]

    def quietest_times(self, phones: Sequence[Phone]) -> Doubles:
        """Return when each phone is quietest, seconds."""
        hop = round(_POWER_STEP_S * MEDIA_RATE_HZ)
        samples = self.clip.samples
        power = np.square(samples[: len(samples) // hop * hop], dtype=float)
        level = power.reshape(-1, hop).mean(axis=1)
        moments = []
        for phone in phones:
            first = round(phone.onset_s / _POWER_STEP_S)
            last = max(round(phone.end_s / _POWER_STEP_S), first + 1)
            if first < len(level):
                moments.append((first + int(np.argmin(level[first:last])) + 0.5) * _POWER_STEP_S)
        return np.array(moments)


def clips_to_score(folder: Path, *, language: str | None = None) -> list[LipClip]:
    """Read the held-out clips of a folder that the shipped viseme parameters were not trained on.

    Clips with sound out of sync are left out. Raises ``UserError`` if no clip is left.
    """
    return _held_out(folder, read_clips(folder, language=language), ())


def read_parts(
    folder: Path, parameters: Collection[Path] = ()
) -> tuple[list[LipClip], list[LipClip]]:
    """Read the clips to score (see ``clips_to_score``) and those for training.

    ``parameters`` are other files of viseme parameters; clips that they were trained on are also
    left out.
    """
    clips = read_clips(folder, language=None)
    return _held_out(folder, clips, parameters), training_clips(clips)


def _held_out(folder: Path, clips: list[LipClip], parameters: Collection[Path]) -> list[LipClip]:
    seen = {name for path in {None, *parameters} for name in training_clip_names(path)}
    clips = [clip for clip in clips if clip.split == "held"]
    if not clips:
        raise UserError(f"{folder}: no clip is held out; list clips or speakers in held.txt")
    faults: dict[str, Callable[[LipClip], bool]] = {
        "that the parameters were trained on": lambda clip: clip.name in seen,
        "whose audio is out of sync": lambda clip: not clip.is_in_sync,
        "without a lip opening (FAP 4 and 5)": lambda clip: bool(
            np.isnan(CURVES["opening"](real_faps(clip))).all()
        ),
    }
    for fault, has_fault in faults.items():
        omitted = [clip.name for clip in clips if has_fault(clip)]
        clips = [clip for clip in clips if clip.name not in omitted]
        if omitted:
            names = textwrap.shorten(", ".join(omitted), _MAX_NAMES_LENGTH, placeholder=" ...")
            print_message(f"omitted {plural(len(omitted), 'clip')} {fault}: {names}")
        if not clips:
            raise UserError(f"{folder}: no clip can be scored")
    return clips
