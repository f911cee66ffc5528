"""Training of the readout of arousal, valence, laughter and breath from the audio encoder's state.

Both parts are ridge regressions on standardized states. Each recording is used twice, unchanged and
augmented (:mod:`kouxing.training.networks.augmentation`).

======== ============================================================= ===============
symbol   meaning                                                       shape
======== ============================================================= ===============
X        standardized states: means over the voice of a recording, or  (rows, width)
         single encoder frames
T        arousal and valence of the emotion, or 1 in laughter or in    (rows, 2)
         breath
a        ridge, relative to the mean square of a state
======== ============================================================= ===============

    W = (X^T X + a n width I)^-1 X^T (T - mean T)

Feelings are tested on each speaker with a readout trained on the other speakers. The second half of
each sound of laughter and breath is held out.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import track
from scipy.stats import spearmanr

from kouxing.corpora.emotions import FEELINGS, read_emotions, speakers_of
from kouxing.corpora.feature_cache import read_audio
from kouxing.corpora.sounds import read_sounds
from kouxing.services.recognizer.acoustic.encoder import (
    EncoderOutput,
    EncoderStream,
    VoiceKind,
    load_encoder,
)
from kouxing.services.recognizer.acoustic.network import FRAMES_PER_ENCODER_FRAME
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.services.recognizer.live.voice_traits import MIN_VOICE, VoiceReadout
from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.audio.pcm import as_floats
from kouxing.training.model_card import write_card
from kouxing.training.model_files import save_voice_readout
from kouxing.training.networks.augmentation import disturb, scale_level
from kouxing.training.seed import SEED

_FEELING_RIDGE, _SOUND_RIDGE = 1.0, 1e-4
_SOUND_WEIGHT = 5.0  # weight of an encoder frame in laughter or breath
_TRAITS = ("laughter", "breath")
_OTHER_STEP = 4  # encoder frames without laughter or breath of which one is used
_MIN_VOICED = 10  # encoder frames
_MIN_DEVIATION = 1e-3


def train_traits(
    recordings: Path, sounds: Sequence[Path], output: Path, *, any_license: bool
) -> None:
    """Train the readout, and write it with its card.

    Raises ``UserError`` if a file cannot be read.
    """
    rng = np.random.default_rng(SEED)
    speech = read_emotions(recordings, any_license=any_license)
    labeled = [recording for recording in speech if recording.emotion]
    means, targets, speaker_names = [], [], []  # one entry per recording with an emotion
    rows, labels = [], []  # encoder frames
    for recording in track(speech, description="speech"):
        for outputs in _encoder_outputs(read_audio(recording.path), rng):
            states = np.stack([output.state for output in outputs])
            rows.append(states[::_OTHER_STEP])
            labels.append(np.zeros((len(rows[-1]), len(_TRAITS)), np.float32))
            if recording.emotion:
                means.append(_mean_state(outputs, states))
                targets.append(FEELINGS[recording.emotion])
                speaker_names.append(recording.speaker)
    for sound in track(read_sounds(sounds, any_license=any_license), description="sounds"):
        if not sound.is_held_out:
            is_trait = [sound.kind == trait for trait in _TRAITS]
            for outputs in _encoder_outputs(as_floats(sound.samples), rng):
                states = np.stack([output.state for output in outputs])
                rows.append(states if any(is_trait) else states[::_OTHER_STEP])
                labels.append(np.tile(np.array(is_trait, np.float32), (len(rows[-1]), 1)))
    voice, feelings, speakers = np.stack(means), np.array(targets), np.array(speaker_names)
    sound_labels = np.concatenate(labels)
    weight = np.where(sound_labels.any(axis=1), _SOUND_WEIGHT, 1.0)
    feeling_fit = _ridge(voice, feelings, np.ones(len(voice)), _FEELING_RIDGE)
    sound_fit = _ridge(np.concatenate(rows), sound_labels, weight, _SOUND_RIDGE)
    weights, bias = (
        np.concatenate(parts, axis=-1).astype(np.float32)
        for parts in zip(feeling_fit, sound_fit, strict=True)
    )
    mean = (voice @ weights[:, :2] + bias[:2]).mean(axis=0)
    save_voice_readout(output, VoiceReadout(weights, bias, mean.astype(np.float32)))
    arousal, valence = _test_speakers(voice, feelings, speakers)
    write_card(
        output,
        title="Voice traits",
        details=f"a linear readout of the audio encoder's state, seed {SEED}",
        recordings=speech,
        notes=(
            f"{len(labeled)} recordings of {len(speakers_of(labeled))} actors name an emotion "
            "(EmoDB: Burkhardt et al. 2005). Arousal and valence of each emotion were placed by "
            "hand on the circumplex of Russell 1980. Each recording is used twice, unchanged and "
            "augmented. All laughter and breaths are from one man.\n\n"
            "Rank correlation with the labels, for each speaker with a readout trained on the "
            f"other speakers: arousal {arousal:.2f}, valence {valence:.2f}."
        ),
    )


def _encoder_outputs(samples: Floats, rng: np.random.Generator) -> Iterator[list[EncoderOutput]]:
    """Yield the encoder's outputs for samples, unchanged and augmented."""
    for sound in (samples, scale_level(disturb(samples, rng), rng)):
        frames = WhisperMel().accept_waveform(sound)
        encoder = EncoderStream(load_encoder())
        yield [
            encoder.process_encoder_frame(frames[start : start + FRAMES_PER_ENCODER_FRAME])
            for start in range(
                0, len(frames) - FRAMES_PER_ENCODER_FRAME + 1, FRAMES_PER_ENCODER_FRAME
            )
        ]


def _mean_state(outputs: Sequence[EncoderOutput], states: Floats) -> Floats:
    voice = np.stack([output.voice for output in outputs])
    is_voiced = voice[:, VoiceKind.SPEECH] + voice[:, VoiceKind.SUNG] > MIN_VOICE
    if is_voiced.sum() >= _MIN_VOICED:
        states = states[is_voiced]
    mean: Floats = states.mean(axis=0)
    return mean


def _ridge(
    states: Floats, targets: NDArray[Any], weight: Doubles, ridge: float
) -> tuple[Doubles, Doubles]:
    """Return W and b for raw states, (rows, width), and targets, (rows, 2)."""
    center = np.average(states, axis=0, weights=weight)
    deviation = np.maximum(states.std(axis=0), _MIN_DEVIATION)
    mean = np.average(targets, axis=0, weights=weight)
    rows = (states - center) / deviation
    weighted = rows * weight[:, None]
    square = weighted.T @ rows + ridge * weight.sum() * np.eye(rows.shape[1])
    weights = np.linalg.solve(square, weighted.T @ (targets - mean)) / deviation[:, None]
    return weights, mean - center @ weights


def _test_speakers(
    states: Floats, feelings: Doubles, speakers: NDArray[Any]
) -> tuple[float, float]:
    """Return the mean rank correlations of arousal and valence over held-out speakers."""
    correlations = []
    for speaker in np.unique(speakers):
        is_held_out = speakers == speaker
        weights, bias = _ridge(
            states[~is_held_out],
            feelings[~is_held_out],
            np.ones((~is_held_out).sum()),
            _FEELING_RIDGE,
        )
        predicted = states[is_held_out] @ weights + bias
        correlations.append(
            [spearmanr(predicted[:, k], feelings[is_held_out, k]).statistic for k in (0, 1)]
        )
    arousal, valence = np.mean(correlations, axis=0)
    return float(arousal), float(valence)
