"""Measures the voice classes of the small ear, and compares its lip features with others.

Voice: the share of time in which the ear detects a voice, laughter or singing. The block network's
phones in the clean recording define "inside" and "outside" speech. ``kouxing evaluate voice``
measures the voice activity that the recognizer derives from these classes.

Lips: the correlation of the lip opening with a linear prediction from the last 160 ms. The
prediction uses audio up to 55 ms after the lip position. It is trained on clips of other speakers,
clean and noisy. The report uses all clips that the ear was not trained on.
"""

from __future__ import annotations

import zlib
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from kouxing.corpora.feature_cache import as_floats, as_integers, samples_of
from kouxing.corpora.lip_clips import LipClip, read_clips
from kouxing.corpora.sounds import Sound, held_out, read_sounds
from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.mouth_profiles.lip_tracks import interpolate_track
from kouxing.services.recognizer.front_end.features import SAMPLE_RATE_HZ
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.services.recognizer.onnx_session import open_network
from kouxing.shared.errors import UserError
from kouxing.shared.terminal import print_table
from kouxing.training.ear.batches import inputs_of, mix
from kouxing.training.ear.export import load_ear
from kouxing.training.ear.network import LOOK_AHEAD
from kouxing.training.ear.recipe import Sources, load_teachers, may_train, utterances_of
from kouxing.training.ear.singing import sing
from kouxing.training.ear.targets import Voice
from kouxing.training.ear.teachers import POSITION_SAMPLES, Teachers
from kouxing.training.lips.recipe import fit_ridge, history_of
from kouxing.training.lips.targets import opening_of

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]
Disturb = Callable[[Floats], Floats]
Audio = tuple[Floats, Mask | None]  # samples, and the positions to evaluate; None: all

_PROBABLE = 0.5
_SNR_DB, _SUNG_SNR_DB = 10.0, 5.0
_DELAY_S = 0.055
_KNOWN_SAMPLES = 720  # from the first sample of a position to the end of the known audio
_MIN_KNOWN = 50  # positions of a clip with a known opening
_NUM_FOLDS = 4  # groups of speakers
_NUM_COMPONENTS = 96
_STRIDE = 2  # every second position fits the linear maps
_LAST_EXTENT = 0.2  # of a linear map's components; the first one's is 1
_MIN_VARIANCE = 1e-8
_NUM_SUNG = 16  # recordings


class EarRunner:
    """Runs an exported ear on whole recordings."""

    def __init__(self, path: Path) -> None:
        """Open a model file, or a checkpoint (.pt); UserError if it cannot be read."""
        self._session = open_network(load_ear(path).tobytes())
        self._width = self._session.get_inputs()[1].shape[1]

    def run(self, samples: Floats) -> dict[str, Floats]:
        """Compute the outputs at all positions, by name."""
        names = [output.name for output in self._session.get_outputs()]
        rows: dict[str, list[Floats]] = {name: [] for name in names}
        state = np.zeros((1, self._width), np.float32)
        for frames in inputs_of(samples):
            outputs = self._session.run(names, {"frames": frames[None], "state": state})
            for name, output in zip(names, outputs, strict=True):
                rows[name].append(output[0])
            state = outputs[names.index("new_state")]
        return {name: np.stack(output) for name, output in rows.items()}


def report_ear(path: Path, sources: Sources, *, whisper: Path, console: Console) -> None:
    """Print both tables for a model file or a checkpoint.

    Raises UserError if a file cannot be read.
    """
    ear = EarRunner(path)
    teachers, inventory = load_teachers(whisper)
    sounds = read_sounds(sources.sounds, shipping=False)
    errors = RowErrors()
    utterances = [
        utterance
        for split in ("dev", "test")
        for utterance in utterances_of(sources, errors, inventory, split)
    ]
    speech = [as_floats(samples) for samples in samples_of(utterances) if len(samples)]
    rows = _voice_rows(speech, sounds, teachers)
    print_table(
        console,
        "share of time, %",
        ("audio", "voice", "laughter", "sung"),
        (
            [name, *(f"{100 * share:.0f}" for share in _voice_shares(ear, audio))]
            for name, audio in track(rows.items(), description="voice")
        ),
    )
    if sources.clips:
        clips = read_clips(sources.clips, any_license=True, language=None)
        _print_lips(ear, teachers, clips, sources, sounds, console)
    errors.report_to(console.print)


def _mix_with(sounds: Sequence[Sound], kind: str, snr_db: float) -> Disturb:
    others = [sound.samples for sound in held_out(sounds, kind)]
    if not others:
        raise UserError(f"the sounds contain no held-out {kind}; add more {kind} to --sounds")

    def disturb(samples: Floats) -> Floats:
        rng = np.random.default_rng(len(samples))
        other = others[int(rng.integers(len(others)))]
        return mix(samples, [other], snr_db, rng).astype(np.float32)

    return disturb


def _conditions(sounds: Sequence[Sound]) -> dict[str, Disturb]:
    return {
        "clean": lambda samples: samples,
        "music 10 dB below": _mix_with(sounds, "music", _SNR_DB),
        "babble 10 dB below": _mix_with(sounds, "babble", _SNR_DB),
    }


def _voice_rows(
    speech: Sequence[Floats], sounds: Sequence[Sound], teachers: Teachers
) -> dict[str, list[Audio]]:
    """Collect the audio of each row of the table."""
    rows: dict[str, list[Audio]] = {
        kind: [(as_floats(sound.samples), None) for sound in held_out(sounds, kind)]
        for kind in ("music", "noise", "breath", "laughter", "singing")
    }
    rng = np.random.default_rng(0)
    long = [samples for samples in speech if len(samples) > SAMPLE_RATE_HZ]
    copies = [sing(samples, len(samples) // POSITION_SAMPLES, rng) for samples in long[:_NUM_SUNG]]
    sung = [(copy.samples, copy.is_sung) for copy in copies if copy]
    rows["sung or held voice"] = list(sung)
    with_music = _mix_with(sounds, "music", _SUNG_SNR_DB)
    rows["the same, music 5 dB below"] = [
        (with_music(samples), is_sung) for samples, is_sung in sung
    ]
    silence = teachers.silence
    phones = [teachers.compute_targets(as_integers(samples)).phones for samples in speech]
    inside = [posteriors[:, silence] < _PROBABLE for posteriors in phones]
    for name, disturb in _conditions(sounds).items():
        disturbed = [disturb(samples) for samples in speech]
        for place, masks in (("inside", inside), ("outside", [~mask for mask in inside])):
            rows[f"speech, {name}: {place}"] = list(zip(disturbed, masks, strict=True))
    return rows


def _voice_shares(ear: EarRunner, audio: Sequence[Audio]) -> list[float]:
    """Return the shares of positions with a voice, with laughter and with a sung voice."""
    shares: list[Mask] = []
    for samples, counted in audio:
        voice = ear.run(samples)["voice"][LOOK_AHEAD:]
        best = voice.argmax(axis=1)
        columns = [voice[:, Voice.NONE] < _PROBABLE, best == Voice.LAUGHTER, best == Voice.SUNG]
        rows = np.stack(columns, axis=1)
        mask = np.full(len(rows), True) if counted is None else counted[: len(rows)]
        shares.append(rows[: len(mask)][mask])
    return np.concatenate(shares).mean(axis=0).tolist() if shares else []


def _print_lips(
    ear: EarRunner,
    teachers: Teachers,
    clips: Sequence[LipClip],
    sources: Sources,
    sounds: Sequence[Sound],
    console: Console,
) -> None:
    conditions = _conditions(sounds)
    in_sync = [(clip, _opening_at_positions(clip)) for clip in clips if clip.is_in_sync]
    usable = [pair for pair in in_sync if np.isfinite(pair[1]).sum() >= _MIN_KNOWN]
    used = [clip for clip, _ in usable]
    targets = [(one - np.nanmean(one)) / np.nanstd(one) for _, one in usable]
    features: dict[str, dict[str, list[Floats]]] = {}
    for condition, disturb in conditions.items():
        of_clips: dict[str, list[Floats]] = defaultdict(list)
        for clip in track(used, description=f"lips, {condition}"):
            for name, values in _lip_features(ear, teachers, disturb(clip.samples)).items():
                of_clips[name].append(values)
        features[condition] = of_clips
    rows = []
    for name in features["clean"]:
        by_condition = {condition: of[name] for condition, of in features.items()}
        rows += _lip_rows(name, used, sources, by_condition, targets)
    print_table(console, "correlation of lip opening, clips", ("input", "clips", *conditions), rows)


def _opening_at_positions(clip: LipClip) -> Floats:
    """Return the lip opening at each position, in FAP units; NaN if unknown."""
    num_positions = len(inputs_of(clip.samples))
    known_s = (POSITION_SAMPLES * np.arange(num_positions) + _KNOWN_SAMPLES) / SAMPLE_RATE_HZ
    opening = interpolate_track(clip.time_s, opening_of(clip), known_s - _DELAY_S)
    return opening.astype(np.float32)


def _lip_features(ear: EarRunner, teachers: Teachers, samples: Floats) -> dict[str, Floats]:
    """Compute the inputs of the linear maps, by name, (positions, n)."""
    inputs = inputs_of(samples)
    frames = WhisperMel().accept_waveform(samples)[: 2 * len(inputs) + 1]
    return {
        "log-mel": inputs,
        "causal network": teachers.causal_values(torch.from_numpy(frames)[None]),
        "ear": ear.run(samples)["features"],
    }


def _lip_rows(
    name: str,
    clips: Sequence[LipClip],
    sources: Sources,
    features: dict[str, list[Floats]],
    targets: Sequence[Floats],
) -> list[list[str]]:
    """Fit maps and return rows with the mean correlation of each source's clips."""
    folds = np.array([zlib.crc32(clip.speaker.encode()) % _NUM_FOLDS for clip in clips])
    scores: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for fold in range(_NUM_FOLDS):
        trained = np.flatnonzero(folds != fold).tolist()
        components = _Components(np.concatenate([features["clean"][number] for number in trained]))
        histories, known = [], []
        for values in features.values():
            for number in trained:
                is_known = ~np.isnan(targets[number])
                histories.append(
                    history_of(components.project(values[number]))[is_known][::_STRIDE]
                )
                known.append(targets[number][is_known, None, None][::_STRIDE])
        weights = fit_ridge(histories, known)[:, 0, 0]
        for number in np.flatnonzero(folds == fold).tolist():
            if may_train(clips[number], sources):
                continue
            for condition, values in features.items():
                opening = history_of(components.project(values[number])) @ weights
                is_known = ~np.isnan(targets[number])
                r = np.corrcoef(opening[is_known], targets[number][is_known])[0, 1]
                scores[clips[number].source][condition].append(float(r))
                scores["all"][condition].append(float(r))
    return [
        [name, f"{source}, {len(of['clean'])}", *(f"{np.mean(r):.2f}" for r in of.values())]
        for source, of in sorted(scores.items())
    ]


class _Components:
    """Principal components of features; later components are scaled down."""

    def __init__(self, features: Floats) -> None:
        self._mean = features.mean(axis=0)
        centered = features - self._mean
        variances, directions = np.linalg.eigh(centered.T @ centered / len(centered))
        number = min(_NUM_COMPONENTS, len(variances))
        extent = np.linspace(1.0, _LAST_EXTENT, number)
        scale = extent / np.sqrt(np.maximum(variances[::-1][:number], _MIN_VARIANCE))
        self._projection = (directions[:, ::-1][:, :number] * scale).astype(np.float32)

    def project(self, features: Floats) -> Floats:
        """Project features, (positions, n)."""
        components: Floats = (features - self._mean) @ self._projection
        return components
