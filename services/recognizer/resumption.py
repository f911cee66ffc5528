"""How a recognizer goes on with a session of a lost one: from a time on, as if it had done it all.

It works through some sound before that time, to know what the other knew: the networks look back
2.5 s. Of that sound it says nothing. What the other said of later sound is void.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.live_decoder import StreamOutput
from kouxing.shared.clock import MEDIA_RATE_HZ, to_samples
from kouxing.shared.phones.events import LipFrame, Phone, Progress, SpeechChange, Waveform

WARM_UP_S = 2.8  # of sound before that time; docs/recognition.md tells how it was chosen
# Sound begins at a multiple of this: of the voice detector's blocks, the networks' positions and
# the feature frames, which then lie as in a session without a loss.
GRID_S = 0.16

Chunk: TypeAlias = tuple[int, NDArray[np.float32]]  # media time; samples, (n, channels)


class Resumption:
    """Keeps back what was said already.

    Parameters
    ----------
    time_s
        Media time up to which phones are known: a phone whose middle lies before it is one of them.
    silence
        The symbol of silence.
    """

    def __init__(self, time_s: float, silence: str) -> None:
        self._time_s = time_s
        self._silence = silence
        self._told: set[int] = set()  # indices of phones emitted, not yet final
        self._is_speaking = False  # at the time, as far as known
        self._has_begun = False

    def on_grid(self, chunk: Chunk, sample_rate_hz: int) -> Chunk:
        """Leave out what is before the next multiple of ``GRID_S``; for chunks before the first."""
        media_time, samples = chunk
        num_skipped = -media_time % round(GRID_S * MEDIA_RATE_HZ)
        begin = min(len(samples), -(-num_skipped * sample_rate_hz // MEDIA_RATE_HZ))
        return media_time + begin * MEDIA_RATE_HZ // sample_rate_hz, samples[begin:]

    def pass_on(self, outputs: Iterable[StreamOutput]) -> list[StreamOutput]:
        """Return what is new of a stream's outputs, first of all whether somebody speaks."""
        passed: list[StreamOutput] = []
        for output in outputs:
            new = self._new_part_of(output)
            if new is None:
                continue
            if not self._has_begun:
                self._has_begun = True
                passed.append(SpeechChange(active=self._is_speaking, time_s=self._time_s))
            passed.append(new)
        return passed

    def _new_part_of(self, output: StreamOutput) -> StreamOutput | None:
        match output:
            case Phone():
                return self._new_phone(output)
            case SpeechChange():
                return self._new_change(output)
            case Waveform():
                return self._new_sound(output)
        is_known = (isinstance(output, Progress) and output.time_s <= self._time_s) or (
            isinstance(output, LipFrame) and output.time_s < self._time_s
        )
        return None if is_known else output

    def _new_change(self, change: SpeechChange) -> SpeechChange | None:
        if not self._has_begun and change.time_s <= self._time_s:
            self._is_speaking = change.active
            return None
        return replace(change, time_s=max(change.time_s, self._time_s))

    def _new_sound(self, sound: Waveform) -> Waveform | None:
        num_known = max(0, to_samples(self._time_s) - to_samples(sound.time_s))
        if num_known == 0:
            return sound
        samples = sound.samples[num_known:]
        return Waveform(time_s=self._time_s, samples=samples) if len(samples) else None

    def _new_phone(self, phone: Phone) -> Phone | None:
        """Return a phone to emit; one that proves to be known already is withdrawn when final."""
        is_new = phone.onset_s + phone.duration_s / 2 >= self._time_s
        was_told = phone.index in self._told
        if phone.final:
            self._told.discard(phone.index)
        elif is_new:
            self._told.add(phone.index)
        if is_new or (was_told and not phone.final):
            return phone
        return replace(phone, symbol=self._silence, duration_s=0.0) if was_told else None
