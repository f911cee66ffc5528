"""The experiment of Zhang et al. 2021, section 6: accuracy of the lips at several speaking rates.

With the displacements ``V`` of the lips' feature points from the closed mouth (eq. 7 to 9,
*reconstructed*),

    accuracy = 1 - sum |V_predicted - V_real| / sum |V_real|

over all vertical displacements of lip points, once over all frames, and once over the mean mouths
of the phones (tables 3 and 4). In the paper, ``V_real`` is the mean of several people who say the
same sentence. Our clips share no sentences, but phones repeat: the mean mouth of a phone is taken
over all its onsets.

Two deviations: each speaker's displacements are scaled so that the widest opening (98th percentile)
equals R = 5. The other rates are the same recording, time-scaled at constant pitch, so that the
real lips are known.

If a clip's transcript is not known, the recognized syllables serve as the text, as in the paper.
"""

import contextlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from rich.progress import track

from kouxing.corpora.lip_clips import LipClip, openings_of, read_clips
from kouxing.evaluation.lips.live_faces import FRAME_RATE_HZ, live_events, live_frames
from kouxing.evaluation.recognizer.disturbances import change_speed
from kouxing.services.lip_models import lip_model_info, lip_models
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.front_end.slices import measure_slices
from kouxing.services.recognizer.lips.lip_predictor import load_lip_predictor
from kouxing.services.recognizer.offline.alignment import align_syllables, drop_pauses
from kouxing.services.recognizer.offline.offline_recognition import recognize_recording
from kouxing.services.synthesizer.lips.ferguson.contour import opening_to_faps
from kouxing.services.synthesizer.lips.ferguson.key_frames import KeyFrames, build_key_frames
from kouxing.services.synthesizer.lips.ferguson.phone_table import MAX_OPENING, load_table
from kouxing.services.synthesizer.lips.ferguson.timing import time_text
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import FAPS, MOUTH_FAPS
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import Syllable
from kouxing.shared.phones.syllable_captions import group_syllables

Samples = Floats
MouthCurve = Callable[[Doubles], Doubles]  # times (n,), seconds -> mouth FAPs (n, num_mouth_faps)

RATES = (0.8, 1.0, 1.5, 2.0)
_MIN_MOUTHS = 3
_LIP_COLUMNS = [
    column
    for column, fap in enumerate(MOUTH_FAPS)
    if FAPS[fap - 1].direction in ("up", "down") and FAPS[fap - 1].feature_points[0][0] in "28"
    if fap != 3
]
_MIDDLE_LIP_COLUMNS = [MOUTH_FAPS.index(4), MOUTH_FAPS.index(5)]


@dataclass(frozen=True, slots=True, kw_only=True)
class RateScore:
    """Accuracy of every method at one speaking rate."""

    rate: float  # relative to the recording
    syllables_per_s: float
    of_frames: dict[str, float]  # accuracy over all frames, by method
    of_phones: dict[str, float]  # accuracy over the mean mouths of phones, by method


def accuracy_of(predicted: Doubles, real: Doubles) -> float:
    """Compare mouth FAPs, (num_frames, num_mouth_faps) each; NaN where not measured."""
    predicted, real = predicted[:, _LIP_COLUMNS], real[:, _LIP_COLUMNS]
    difference, size = np.abs(predicted - real), np.abs(real)
    return 1.0 - float(np.nansum(difference) / np.sum(size[np.isfinite(difference)]))


def score_rates(folder: Path) -> list[RateScore]:
    """Score all methods on the held-out Mandarin clips that are in sync."""
    clips = [clip for clip in read_clips(folder) if clip.split == "held" and clip.is_in_sync]
    if not clips:
        raise UserError(f"{folder} has no held-out clips with audio in sync")
    real = scale_openings([clip.speaker for clip in clips], [clip.faps for clip in clips])
    model = load_model()
    return [_score_rate(model, clips, real, rate) for rate in RATES]


def _score_rate(
    model: AcousticModel, clips: Sequence[LipClip], real: Sequence[Doubles], rate: float
) -> RateScore:
    num_syllables, seconds = 0, 0.0
    symbols: list[str] = []
    real_onsets: list[Doubles] = []
    frames: dict[str, list[Doubles]] = defaultdict(list)
    onsets: dict[str, list[Doubles]] = defaultdict(list)
    progress = track(clips, description=f"{rate:g} times the rate")
    for clip, faps in zip(progress, real, strict=True):
        samples = clip.samples if rate == 1.0 else change_speed(clip.samples, rate)
        times_s = clip.time_s / rate
        syllables, phones = _syllables_and_phones(model, clip, samples)
        num_syllables += len(syllables)
        seconds += sum(phone.duration_s for phone in phones)
        onsets_s = np.array([phone.onset_s for phone in phones])
        symbols += [phone.symbol for phone in phones]
        real_onsets.append(_interpolate(onsets_s, times_s, faps))
        for name, curves in _methods(model, samples, syllables, phones):
            frames[name].append(curves(times_s))
            onsets[name].append(curves(onsets_s))
    frames_of = {name: np.concatenate(mouths) for name, mouths in frames.items()}
    means_of = {name: mean_mouths(symbols, np.concatenate(faps)) for name, faps in onsets.items()}

    def method_accuracies(predicted: Mapping[str, Doubles], real: Doubles) -> dict[str, float]:
        return {name: accuracy_of(mouths, real) for name, mouths in predicted.items()}

    return RateScore(
        rate=rate,
        syllables_per_s=num_syllables / max(seconds, 1e-9),
        of_frames=method_accuracies(frames_of, np.concatenate(real)),
        of_phones=method_accuracies(means_of, mean_mouths(symbols, np.concatenate(real_onsets))),
    )


def mean_mouths(symbols: Sequence[str], mouths: Doubles) -> Doubles:
    """Return the mean mouth of each phone that occurs at least 3 times, NaN where never measured.

    ``symbols`` has the phone of each mouth; mouths are FAPs (num_mouths, num_mouth_faps).
    """
    means = []
    for symbol in sorted(set(symbols)):
        rows = mouths[[other == symbol for other in symbols]]
        if len(rows) >= _MIN_MOUTHS:
            num_measured = np.isfinite(rows).sum(axis=0)
            total = np.nansum(rows, axis=0)
            means.append(np.where(num_measured, total / np.maximum(num_measured, 1), np.nan))
    return np.array(means).reshape(-1, mouths.shape[1])


def scale_openings(speakers: Sequence[str], mouths: Sequence[Doubles]) -> list[Doubles]:
    """Scale FAPs (num_frames, num_mouth_faps) so that every speaker's widest opening is R = 5."""
    full = -float(opening_to_faps([MAX_OPENING])[0, _MIDDLE_LIP_COLUMNS].sum())
    _, widest = openings_of(speakers, mouths)
    return [faps * full / widest[speaker] for speaker, faps in zip(speakers, mouths, strict=True)]


def _syllables_and_phones(
    model: AcousticModel, clip: LipClip, samples: Samples
) -> tuple[list[Syllable], list[Phone]]:
    """Return the syllables of a clip, known or recognized, and their phones with real times."""
    if clip.transcript:
        with contextlib.suppress(UserError):  # a transcript with words in another language
            syllables = model.inventory.pronounce(clip.transcript)
            phones = align_syllables(model, samples, syllables).phones
            return syllables, drop_pauses(phones, model.inventory)
    phones = drop_pauses(recognize_recording(model, samples), model.inventory)
    groups = group_syllables(phones, model.inventory)
    return [tuple(phone.symbol for phone in group) for group in groups], phones


def _methods(
    model: AcousticModel, samples: Samples, syllables: Sequence[Syllable], phones: Sequence[Phone]
) -> Iterator[tuple[str, MouthCurve]]:
    """Yield the name and the curves of each method."""
    inventory = model.inventory
    table = load_table(inventory)
    by_endpoints = time_text(measure_slices(samples), syllables, table)
    for name, timed in (("text by endpoints", by_endpoints), ("text by alignment", phones)):
        yield name, _curves_of(build_key_frames(timed, table))
    delays_s = {name: lip_model_info(name).delay_ms / 1e3 for name in lip_models()}
    events = live_events(model, samples, load_lip_predictor(), sorted(set(delays_s.values())))
    for name, delay_s in delays_s.items():
        lips = load_lip_model(inventory.language, name)
        frames = live_frames(lips, events[delay_s], delay_s)
        mouth = frames[:, np.array(MOUTH_FAPS) - 1]
        frame_s = np.arange(len(mouth)) / FRAME_RATE_HZ
        yield f"{name}, live", partial(_interpolate, frame_s=frame_s, mouths=mouth)


def _curves_of(motion: KeyFrames) -> MouthCurve:
    return lambda times_s: opening_to_faps(motion.openings_at(times_s))


def _interpolate(times_s: Doubles, frame_s: Doubles, mouths: Doubles) -> Doubles:
    return np.stack([np.interp(times_s, frame_s, column) for column in mouths.T], axis=1)
