"""Starts and ends of speech and laughter, from the probabilities of the ear."""

import numpy as np

from kouxing.services.recognizer.ear import Voice
from kouxing.services.recognizer.front_end.vad import VoiceActivityDetector

PER_S = 50  # positions


def states(voices: list[tuple[Voice, float, int]]) -> tuple[np.ndarray, np.ndarray]:
    """Return the speech and laughter after each position.

    A voice has a probability for a number of positions; the rest is no voice.
    """
    detector = VoiceActivityDetector()
    seen = []
    for voice, probability, num_positions in voices:
        row = np.zeros(len(Voice), np.float32)
        row[Voice.NONE] = 1 - probability
        row[voice] += probability
        for _ in range(num_positions):
            detector.update(row)
            seen.append((detector.is_speech, detector.is_laughter))
    speech, laughter = np.array(seen).T
    return speech, laughter


def test_speech_starts_at_once_and_ends_after_half_a_second() -> None:
    speech, laughter = states([(Voice.NONE, 0, 10), (Voice.SPEECH, 0.9, 10), (Voice.NONE, 0, 50)])
    assert np.flatnonzero(speech).tolist() == list(range(10, 20 + PER_S // 2 - 1))
    assert not laughter.any()


def test_a_weak_syllable_or_a_closure_does_not_end_the_speech() -> None:
    weak, closure = (Voice.SPEECH, 0.4, 60), (Voice.NONE, 0, 20)
    speech, _ = states([(Voice.SPEECH, 0.9, 5), weak, closure, (Voice.SPEECH, 0.9, 5)])
    assert speech.all()
    speech, _ = states([weak])
    assert not speech.any()


def test_a_sung_vowel_is_speech_until_it_ends() -> None:
    speech, _ = states([(Voice.SPEECH, 0.9, 5), (Voice.SUNG, 0.9, 500)])
    assert speech.all()


def test_laughter_in_bursts_is_not_speech() -> None:
    burst, pause = (Voice.LAUGHTER, 0.9, 5), (Voice.NONE, 0, 3)
    speech, laughter = states([burst, pause, burst, pause, burst, (Voice.NONE, 0, 50)])
    assert not speech.any()
    assert not laughter[:4].any()
    assert laughter[12:40].all()
    assert not laughter[-PER_S // 4 :].any()


def test_a_syllable_like_laughter_does_not_count() -> None:
    _, laughter = states([(Voice.SPEECH, 0.9, 9), (Voice.LAUGHTER, 0.9, 3), (Voice.SPEECH, 0.9, 9)])
    assert not laughter.any()
