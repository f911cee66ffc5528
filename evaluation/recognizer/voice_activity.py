"""Measures voice activity, laughter and breath: the fraction of time with each, by kind of audio.

The audio passes through a live recognizer in slices of 20 ms. The state of a slice is the newest
state that the recognizer has reported (``SpeechChange``, ``Progress``) after processing the slice.
The share therefore includes the delays of the detector, such as the half second before speech ends.

- Speech: the recordings of a corpus, with 2 s of silence before and after each, clean and with
  music or babble. Forced alignment of the text finds the phones. Only phones count as a voice.
- Held-out recordings of a folder of sounds (:mod:`kouxing.corpora.sounds`).
- Synthesized sounds (:mod:`~kouxing.evaluation.recognizer.synthetic_sounds`).
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from rich.progress import track

from kouxing.corpora.sounds import Sound, held_out
from kouxing.evaluation.recognizer import synthetic_sounds
from kouxing.evaluation.recognizer.aligned_corpus import AlignedRecording
from kouxing.evaluation.recognizer.disturbances import Disturb, add_sound
from kouxing.evaluation.recognizer.synthetic_sounds import Samples
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.front_end.features import SAMPLE_RATE_HZ
from kouxing.services.recognizer.front_end.slices import SLICE_SAMPLES, split_slices
from kouxing.services.recognizer.live.recognizer import Recognizer
from kouxing.shared.arrays import Mask
from kouxing.shared.audio.pcm import as_floats
from kouxing.shared.command.terminal import CONSOLE
from kouxing.shared.phones.events import Phone, Progress, SpeechChange

# a kind of audio, and its recordings, each with a mask of the slices with a voice
LabeledAudio = tuple[str, Sequence[tuple[Samples, Mask]]]

_SLICE_S = SLICE_SAMPLES / SAMPLE_RATE_HZ
_PAUSE = 2 * SAMPLE_RATE_HZ  # samples of silence before and after a recording of speech
_SYNTHETIC_S = 60.0
_SUNG_OVER_MUSIC_DB = 5.0
_SOUND_KINDS = {"singing": True, "laughter": False, "breath": False, "music": False, "noise": False}


def labeled_audio(
    references: Sequence[AlignedRecording],
    disturbances: Mapping[str, Disturb],
    music: Samples,
    sounds: Sequence[Sound],
) -> Iterator[LabeledAudio]:
    """Read, disturb and synthesize the audio, one kind at a time.

    ``music`` accompanies the melodies.
    """
    speech = [np.pad(reference.read_audio(), _PAUSE) for reference in references]
    voiced = [
        _voiced_slices(reference.phones, len(samples))
        for reference, samples in zip(references, speech, strict=True)
    ]
    for name, disturb in disturbances.items():
        yield f"speech, {name}", [*zip(map(disturb, speech), voiced, strict=True)]
    for kind, is_voice in _SOUND_KINDS.items():
        recordings = [as_floats(sound.samples) for sound in held_out(sounds, kind)]
        if recordings:
            yield _label_all(kind, recordings, is_voice=is_voice)
    melodies = synthetic_sounds.melodies()
    over_music = [add_sound(melody, music, _SUNG_OVER_MUSIC_DB) for melody in melodies]
    yield _label_all("melody", melodies, is_voice=True)
    yield _label_all("melody, music 5 dB", over_music, is_voice=True)
    yield _label_all("held vowels", synthetic_sounds.held_vowels(), is_voice=True)
    for name, make in synthetic_sounds.VOICELESS_SOUNDS.items():
        yield _label_all(name, [make(_SYNTHETIC_S)], is_voice=False)


def _label_all(kind: str, recordings: Iterable[Samples], *, is_voice: bool) -> LabeledAudio:
    return kind, [
        (sound, np.full(-(-len(sound) // SLICE_SAMPLES), is_voice)) for sound in recordings
    ]


def _voiced_slices(phones: Sequence[Phone], num_samples: int) -> Mask:
    """Return whether the middle of each slice is in a phone, after the pause."""
    middle_s = (
        (np.arange(-(-num_samples // SLICE_SAMPLES)) + 0.5) * SLICE_SAMPLES - _PAUSE
    ) / SAMPLE_RATE_HZ
    mask = np.zeros(len(middle_s), np.bool_)
    for phone in phones:
        mask |= (phone.onset_s <= middle_s) & (middle_s < phone.end_s)
    return mask


def evaluate_voice(
    model: AcousticModel, materials: Iterable[LabeledAudio]
) -> dict[str, dict[str, Any]]:
    """Measure voice activity; return figures for a JSON file, by kind of audio.

    The figures contain the seconds with and without a voice, and the fraction of each with voice
    activity. Without such audio, the share is missing: None. The shares with laughter and with
    breath refer to the whole time.
    """
    results = {}
    for kind, recordings in track(materials, "voice activity", console=CONSOLE, transient=True):
        voiced = np.concatenate([mask for _, mask in recordings])
        states = [voice_states(model, samples) for samples, _ in recordings]
        is_on, laughter, breath = np.concatenate(states).T
        parts = {"voice": voiced, "no_voice": ~voiced}
        results[kind] = {
            "seconds": {part: float(mask.sum()) * _SLICE_S for part, mask in parts.items()},
            "on": {
                part: float(is_on[mask].mean()) if mask.any() else None
                for part, mask in parts.items()
            },
            "laughter": float(laughter.mean()),
            "breath": float(breath.mean()),
        }
    return results


def voice_states(model: AcousticModel, samples: Samples) -> Mask:
    """Return the states that the live recognizer reports after each slice, (n, 3).

    The states are voice activity, laughter and breath.
    """
    recognizer = Recognizer(model)
    stream = recognizer.create_stream()
    is_active = is_laughter = is_breath = False
    states = []
    for piece in split_slices(samples, 0):
        stream.accept_waveform(piece)
        recognizer.decode_streams([stream])
        for event in stream.take_results():
            if isinstance(event, SpeechChange):
                is_active = event.active
            elif isinstance(event, Progress):
                is_laughter, is_breath = event.is_laughter, event.is_breath
        states.append((is_active, is_laughter, is_breath))
    return np.array(states)
