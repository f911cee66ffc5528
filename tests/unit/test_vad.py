"""Starts and ends of speech, from the probabilities of the ear."""

import numpy as np

from kouxing.services.recognizer.ear import Voice
from kouxing.services.recognizer.front_end.vad import VoiceActivityDetector

PER_S = 50  # positions


def speech(voices: list[tuple[Voice, float, int]]) -> np.ndarray:
    """Return whether there is speech after each position.

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
            seen.append(detector.is_speech)
    return np.array(seen)


def test_speech_starts_at_once_and_ends_after_half_a_second() -> None:
    states = speech([(Voice.NONE, 0, 10), (Voice.SPEECH, 0.9, 10), (Voice.NONE, 0, 50)])
    assert np.flatnonzero(states).tolist() == list(range(10, 20 + PER_S // 2 - 1))


def test_a_weak_syllable_or_a_closure_does_not_end_the_speech() -> None:
    weak, closure = (Voice.SPEECH, 0.4, 60), (Voice.NONE, 0, 20)
    assert speech([(Voice.SPEECH, 0.9, 5), weak, closure, (Voice.SPEECH, 0.9, 5)]).all()
    assert not speech([weak]).any()


def test_a_sung_vowel_is_speech_until_it_ends() -> None:
    assert speech([(Voice.SPEECH, 0.9, 5), (Voice.SUNG, 0.9, 500)]).all()


def test_laughter_in_bursts_is_not_speech() -> None:
    burst, pause = (Voice.LAUGHTER, 0.9, 5), (Voice.NONE, 0, 3)
    assert not speech([burst, pause, burst, pause, burst, (Voice.NONE, 0, 50)]).any()
