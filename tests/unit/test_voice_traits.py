"""Voice activity and traits of a voice, from the encoder."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from kouxing.services.recognizer.acoustic.encoder import EncoderOutput, VoiceKind, load_encoder
from kouxing.services.recognizer.front_end.vad import VoiceActivityDetector
from kouxing.services.recognizer.live.voice_traits import (
    NUM_TRAITS,
    VoiceReadout,
    VoiceTraits,
    VoiceTraitsStream,
    load_voice_readout,
)
from kouxing.shared.errors import UserError
from kouxing.training.model_files import save_voice_readout, write_archive

PER_S = 50  # encoder frames


def speech(voices: list[tuple[VoiceKind, float, int]]) -> np.ndarray:
    """Return whether there is speech after each encoder frame.

    A voice has a probability for a number of encoder frames; the rest is no voice.
    """
    detector = VoiceActivityDetector()
    seen = []
    for voice, probability, num_positions in voices:
        row = np.zeros(len(VoiceKind), np.float32)
        row[VoiceKind.NONE] = 1 - probability
        row[voice] += probability
        for _ in range(num_positions):
            detector.update(row)
            seen.append(detector.is_speech)
    return np.array(seen)


def test_speech_starts_at_once_and_ends_after_half_a_second() -> None:
    states = speech([(VoiceKind.NONE, 0, 10), (VoiceKind.SPEECH, 0.9, 10), (VoiceKind.NONE, 0, 50)])
    assert np.flatnonzero(states).tolist() == list(range(10, 20 + PER_S // 2 - 1))


def test_a_weak_syllable_or_a_closure_does_not_end_the_speech() -> None:
    weak, closure = (VoiceKind.SPEECH, 0.4, 60), (VoiceKind.NONE, 0, 20)
    assert speech([(VoiceKind.SPEECH, 0.9, 5), weak, closure, (VoiceKind.SPEECH, 0.9, 5)]).all()
    assert not speech([weak]).any()


def test_a_sung_vowel_is_speech_until_it_ends() -> None:
    assert speech([(VoiceKind.SPEECH, 0.9, 5), (VoiceKind.SUNG, 0.9, 500)]).all()


def test_laughter_in_bursts_is_not_speech() -> None:
    burst, pause = (VoiceKind.LAUGHTER, 0.9, 5), (VoiceKind.NONE, 0, 3)
    assert not speech([burst, pause, burst, pause, burst, (VoiceKind.NONE, 0, 50)]).any()


# the first states are the traits themselves
READOUT = VoiceReadout(
    np.eye(NUM_TRAITS, dtype=np.float32), np.zeros(NUM_TRAITS, np.float32), np.zeros(2, np.float32)
)


def traits_of(*parts: tuple[float, VoiceKind, Sequence[float]]) -> list[VoiceTraits]:
    """Return the traits after each encoder frame of parts: duration in s, kind of voice, state."""
    stream = VoiceTraitsStream(READOUT)
    none = np.zeros(0, np.float32)
    seen = []
    for duration_s, kind, state in parts:
        voice = np.eye(len(VoiceKind), dtype=np.float32)[kind]
        output = EncoderOutput(none, none, none, voice, np.array(state, np.float32))
        for _ in range(round(duration_s * PER_S)):
            stream.process_encoder_frame(output)
            seen.append(stream.newest)
    return seen


def test_feelings_are_relative_to_the_voice_so_far() -> None:
    excited, calm = [0.6, 0.3, 0, 0], [-0.2, 0.3, 0, 0]
    seen = traits_of((60.0, VoiceKind.SPEECH, calm), (3.0, VoiceKind.SPEECH, excited))
    before, after = seen[60 * PER_S - 1], seen[-1]
    assert abs(before.arousal) < 0.05  # a calm voice is this speaker's usual voice
    assert after.arousal > 0.5
    assert abs(after.valence) < 0.1
    assert max(trait.arousal for trait in seen) <= 1.0


def test_silence_does_not_change_the_feeling() -> None:
    voiced = (2.0, VoiceKind.SPEECH, [0.6, -0.3, 0, 0])
    seen = traits_of(voiced, (5.0, VoiceKind.NONE, [-1.0, 1.0, 0, 0]))
    assert seen[2 * PER_S - 1][:2] == seen[-1][:2]
    assert seen[-1].arousal > 0.2


def test_laughter_and_breath_need_evidence_and_do_not_flicker() -> None:
    laughs, breathes, nothing = [0, 0, 1, 0], [0, 0, 0, 1], [0, 0, 0, 0]
    bursts = [(0.1, VoiceKind.LAUGHTER, laughs), (0.06, VoiceKind.NONE, nothing)] * 6
    seen = traits_of((1.0, VoiceKind.NONE, nothing), *bursts, (1.0, VoiceKind.NONE, nothing))
    laughter = np.array([trait.is_laughter for trait in seen])
    assert not laughter[: PER_S + 2].any()
    assert np.count_nonzero(np.diff(laughter)) == 2  # it starts once and ends once
    assert not laughter[-PER_S // 2 :].any()
    assert not any(trait.is_breath for trait in seen)
    breath = traits_of((0.5, VoiceKind.NONE, breathes))
    assert breath[-1].is_breath
    assert not breath[-1].is_laughter


def test_silence_and_speech_end_laughter() -> None:
    laughs = [0, 0, 0.8, 0]
    for after in (VoiceKind.NONE, VoiceKind.SPEECH):
        seen = traits_of((2.0, VoiceKind.LAUGHTER, laughs), (3.0, after, laughs))
        assert seen[2 * PER_S].is_laughter
        assert not any(trait.is_laughter for trait in seen[3 * PER_S :])


def test_the_shipped_readout_fits_the_encoder_and_others_are_rejected(tmp_path: Path) -> None:
    assert load_voice_readout().weights.shape == (load_encoder().state_width, NUM_TRAITS)
    save_voice_readout(tmp_path / "small.npz", READOUT)
    with pytest.raises(UserError, match="weights has shape"):
        load_voice_readout(tmp_path / "small.npz")
    write_archive(tmp_path / "other.npz", {"format": np.array("encoder 1")})
    with pytest.raises(UserError, match="format 'encoder 1'"):
        load_voice_readout(tmp_path / "other.npz")
