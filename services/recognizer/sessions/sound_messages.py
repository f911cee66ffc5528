"""Joins a session's audio into longer messages, because every message has a fixed cost."""

from collections.abc import Iterator

import numpy as np
from kouxing_client.messages import Sound

from kouxing.shared.audio.pcm import as_integers
from kouxing.shared.clock import MEDIA_RATE_HZ, to_samples
from kouxing.shared.phones.events import Waveform
from kouxing.shared.wire.speech import AudioState, Progress

MESSAGE_S = 0.04  # duration of a message; less if the face has a shorter delay


class SoundMessages:
    """Joins audio into messages. A message is delayed by no more than ``face_delay_s``."""

    def __init__(self, face_delay_s: float) -> None:
        self._num_joined = round(min(MESSAGE_S, face_delay_s) * MEDIA_RATE_HZ)  # samples
        self._start = 0  # media time, samples
        self._samples = np.empty(0, np.float32)

    def add(self, result: Waveform | Progress) -> Iterator[Sound]:
        """Add sound, or the state of the audio; yield the messages that are complete."""
        if isinstance(result, Waveform):
            start = to_samples(result.time_s)
            if start != self._start + len(self._samples):  # after a gap
                yield from self._take()
                self._start = start
            self._samples = np.concatenate([self._samples, result.samples])
            if len(self._samples) >= self._num_joined:
                yield from self._take()
        elif result.state == AudioState.ENDED:
            yield from self._take()

    def _take(self) -> Iterator[Sound]:
        if len(self._samples):
            yield Sound(media_time=self._start, pcm=as_integers(self._samples).tobytes())
            self._start += len(self._samples)
            self._samples = self._samples[:0]
