"""Measures the motion of a live face apart from its lips: emotion, nods, brows, blinks, stillness.

The recordings of each speaker are one session, with pauses between them. The manifest names
their emotions (:mod:`kouxing.corpora.emotions`), and may give the times of stressed vowels. A
second face is at rest for a minute.

- Rank correlations (Spearman) with arousal or valence of the named emotion, mean over speakers:
  of the estimated arousal and valence, the size of the mouth's motion, and the height of the brows.
- Nods and brow raises: peaks of the head's pitch and of the brows. Those during a recording match a
  stressed vowel if the last one started 0.1 to 0.3 s before the peak. The chance is the fraction of
  all times that match. Movements within 0.6 s after a recording mark the end of the phrase.
- Blinks per minute and their median duration.
- Still frames: no FAP moves by more than 0.01 degrees or 0.5 FAP units.

The shipped readout was trained on the actors of EmoDB. Its card has the correlations for unseen
speakers.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from rich.progress import track
from scipy.signal import find_peaks
from scipy.stats import spearmanr

from kouxing.corpora.emotions import FEELINGS, EmotionRecording, speakers_of
from kouxing.corpora.feature_cache import read_audio
from kouxing.evaluation.lips.lip_measures import opening_range
from kouxing.services.live_pipeline import LivePipeline
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.face_animator import configured_face
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.arrays import Doubles, Floats, Mask
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.command.terminal import CONSOLE
from kouxing.shared.face.faps import DEGREE, FAP_NUMBER
from kouxing.shared.phones.events import Progress

Times = Doubles  # (n,) media times, seconds

_PAUSE_S = 0.6  # pause between recordings
_CHUNK = MEDIA_RATE_HZ // 10
_REST_S = 60.0
_MATCH_S = (0.1, 0.3)  # range of the time from a stressed vowel to the peak of its movement
_NOD_DEG, _BROW_UNITS = 0.5, 15.0  # prominence of peaks
_CLOSED_LID = 450.0  # FAP units, half of a closed lid
_STILL_DEG, _STILL_UNITS = 0.01, 0.5
_BROW, _LID, _PITCH, _UPPER, _LOWER = (
    FAP_NUMBER[name] - 1
    for name in (
        "raise_l_m_eyebrow",
        "close_t_l_eyelid",
        "head_pitch",
        "lower_t_midlip",
        "raise_b_midlip",
    )
)
_ANGLES = [
    number - 1
    for name, number in FAP_NUMBER.items()
    if name.startswith("head_") or ("eyeball" in name and not name.startswith("thrust"))
]


@dataclass(frozen=True, slots=True)
class MovementStats:
    """Rate of a movement, and how often it matches a stressed vowel."""

    per_minute: float  # rate per minute of speech
    at_end: float  # fraction after a phrase
    matched: float | None  # fraction of the others; None without any or without stressed vowels


@dataclass(frozen=True, slots=True)
class FaceFigures:
    """Metrics of a face."""

    correlations: Mapping[str, float]
    nods: MovementStats
    brow_raises: MovementStats
    chance: float | None  # probability of matching a stressed vowel by chance
    blinks_per_minute: float
    blink_s: float  # median duration
    still_speaking: float  # fractions of frames
    still_at_rest: float
    longest_still_s: float


@dataclass(frozen=True, slots=True)
class _Session:
    """The face of one speaker."""

    faps: Floats  # (frames, 68)
    spans: Sequence[tuple[float, float]]  # start and end of each recording
    feelings: Sequence[tuple[float, float]]  # estimated at the end of each recording
    stressed_s: Times

    def select_spoken(self, times_s: Times, margin_s: float = 0.0) -> Times:
        """Return the times during a recording, or less than ``margin_s`` after it."""
        is_spoken = [(start <= times_s) & (times_s < end + margin_s) for start, end in self.spans]
        return np.asarray(times_s[np.any(is_spoken, axis=0)])


def measure_face(model: AcousticModel, recordings: Sequence[EmotionRecording]) -> FaceFigures:
    """Animate all recordings that name an emotion, and a face at rest."""
    config = SynthesizerConfig()
    labeled = [recording for recording in recordings if recording.emotion]
    by_speaker = [
        [recording for recording in labeled if recording.speaker == speaker]
        for speaker in speakers_of(labeled)
    ]
    sessions = [
        _animate(model, speech, config)
        for speech in track(by_speaker, "speakers", console=CONSOLE, transient=True)
    ]
    labels = [
        np.array([FEELINGS[recording.emotion or ""] for recording in speech])
        for speech in by_speaker
    ]
    rate_hz = config.frame_rate_hz
    minutes = sum(end - start for session in sessions for start, end in session.spans) / 60
    frames = np.concatenate([session.faps for session in sessions])
    blinks_s = _blink_durations_s(frames, rate_hz)
    nods_s = [_find_peaks(session, _PITCH, _NOD_DEG * DEGREE, rate_hz) for session in sessions]
    brow_raises_s = [_find_peaks(session, _BROW, _BROW_UNITS, rate_hz) for session in sessions]
    all_times_s = [
        np.concatenate([np.arange(*span, 0.02) for span in session.spans]) for session in sessions
    ]
    still = [_is_still(session.faps) for session in sessions]
    face = configured_face(load_lip_model(name=config.lips), config)
    at_rest = face.relax(round(_REST_S * config.frame_rate_hz))
    still_at_rest = _is_still(np.array([faps for _, faps in at_rest]))
    return FaceFigures(
        correlations=_correlations(sessions, labels, rate_hz),
        nods=_movement_stats(nods_s, sessions, minutes),
        brow_raises=_movement_stats(brow_raises_s, sessions, minutes),
        chance=_match_rate(all_times_s, sessions),
        blinks_per_minute=60 * rate_hz * len(blinks_s) / len(frames),
        blink_s=float(np.median(blinks_s)) if len(blinks_s) else 0.0,
        still_speaking=float(np.concatenate(still).mean()),
        still_at_rest=float(still_at_rest.mean()),
        longest_still_s=max(map(_longest_run, [*still, still_at_rest])) / rate_hz,
    )


def _animate(
    model: AcousticModel, recordings: Sequence[EmotionRecording], config: SynthesizerConfig
) -> _Session:
    """Stream the recordings of a speaker as one session."""
    pipeline = LivePipeline(model, load_lip_model(name=config.lips), synthesizer=config)
    pause = np.zeros(round(_PAUSE_S * MEDIA_RATE_HZ), np.float32)
    frames, spans, stressed = [], [], []
    start = 0  # samples
    for recording in recordings:
        samples = read_audio(recording.path)
        joined = np.concatenate([samples, pause])
        for first in range(0, len(joined), _CHUNK):
            frames += pipeline.accept_waveform(joined[first : first + _CHUNK])
        start_s = start / MEDIA_RATE_HZ
        spans.append((start_s, (start + len(samples)) / MEDIA_RATE_HZ))
        stressed += [start_s + time_s for time_s in recording.stressed_s]
        start += len(joined)
    frames += pipeline.input_finished()
    progress = [event for event in pipeline.events if isinstance(event, Progress)]
    times_s = np.array([event.time_s for event in progress])
    ends = np.searchsorted(times_s, [end_s for _, end_s in spans]) - 1
    return _Session(
        np.array([faps for _, faps in frames]),
        spans,
        [(progress[end].arousal, progress[end].valence) for end in ends],
        np.array(stressed),
    )


def _correlations(
    sessions: Sequence[_Session], labels: Sequence[Doubles], rate_hz: float
) -> dict[str, float]:
    correlations: dict[str, list[float]] = {}
    for session, label in zip(sessions, labels, strict=True):
        parts = [
            session.faps[round(start * rate_hz) : round(end * rate_hz)]
            for start, end in session.spans
        ]
        openings = [
            opening_range(-(part[:, _UPPER] + part[:, _LOWER]).astype(np.float64)) for part in parts
        ]
        # Expressions build up slowly, so only the second half counts.
        brows = [part[len(part) // 2 :, _BROW].mean() for part in parts]
        arousal, valence = np.array(session.feelings).T
        for name, values, column in (
            ("arousal", arousal, 0),
            ("valence", valence, 1),
            ("size of the mouth, with arousal", openings, 0),
            ("height of the brows, with arousal", brows, 0),
        ):
            statistic = spearmanr(values, label[:, column]).statistic
            correlations.setdefault(name, []).append(float(statistic))
    return {name: float(np.nanmean(values)) for name, values in correlations.items()}


def _find_peaks(session: _Session, fap: int, prominence: float, rate_hz: float) -> Times:
    """Return the times of the peaks of a FAP while the speaker speaks."""
    peaks, _ = find_peaks(session.faps[:, fap], prominence=prominence)
    return session.select_spoken(peaks / rate_hz, _PAUSE_S)


def _movement_stats(
    times: Sequence[Times], sessions: Sequence[_Session], minutes: float
) -> MovementStats:
    num_movements = sum(map(len, times))
    within = [
        session.select_spoken(times_s) for times_s, session in zip(times, sessions, strict=True)
    ]
    at_end = 1.0 - sum(map(len, within)) / max(num_movements, 1)
    return MovementStats(num_movements / minutes, at_end, _match_rate(within, sessions))


def _match_rate(times: Sequence[Times], sessions: Sequence[_Session]) -> float | None:
    """Return the fraction of times that follow the start of a stressed vowel."""
    shortest_s, longest_s = _MATCH_S
    lags_s: list[float] = []
    for times_s, session in zip(times, sessions, strict=True):
        starts_s = np.array([-np.inf, *session.stressed_s])
        if len(starts_s) > 1:
            last_s = starts_s[np.searchsorted(starts_s, times_s, side="right") - 1]
            lags_s += (times_s - last_s).tolist()
    matches = [shortest_s <= lag_s <= longest_s for lag_s in lags_s]
    return sum(matches) / len(matches) if matches else None


def _blink_durations_s(faps: Floats, rate_hz: float) -> Times:
    closed = np.pad((faps[:, _LID] > _CLOSED_LID).astype(int), 1)
    changes = np.diff(closed)
    return (np.flatnonzero(changes < 0) - np.flatnonzero(changes > 0)) / rate_hz


def _is_still(faps: Floats) -> Mask:
    """Return whether each frame, except the first, looks like the previous frame."""
    limits = np.full(faps.shape[1], _STILL_UNITS)
    limits[_ANGLES] = _STILL_DEG * DEGREE
    still: Mask = np.all(np.abs(np.diff(faps, axis=0)) <= limits, axis=1)
    return still


def _longest_run(mask: Mask) -> int:
    changes = np.flatnonzero(~np.concatenate([[False], mask, [False]]))
    return int(np.diff(changes).max() - 1)
