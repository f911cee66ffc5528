"""Continues the session of a lost recognizer.

The new recognizer first reprocesses some earlier audio, because the networks look back 2.5 s. It
does not emit results for that audio. Its later results replace those of the lost recognizer.
"""

from collections import deque
from collections.abc import Iterable
from typing import TypeAlias

from kouxing_client.audio import MAX_KEPT_MESSAGES
from kouxing_client.messages import Message

from kouxing.services.recognizer.live.live_decoder import StreamOutput
from kouxing.shared.arrays import Floats
from kouxing.shared.clock import MEDIA_RATE_HZ, to_samples
from kouxing.shared.fast_record import replace
from kouxing.shared.phones.events import LipPositions, Phone, Progress, SpeechChange, Waveform
from kouxing.shared.phones.inventory import SILENCE
from kouxing.shared.wire import speech
from kouxing.shared.wire.final_time import FinalTimeTracker

WARM_UP_S = 2.8  # duration of the reprocessed audio; docs/recognition.md explains the choice
# Audio starts at a multiple of this time. Network blocks and encoder frames divide it, so they are
# aligned as in an uninterrupted session.
GRID_S = 0.16

Chunk: TypeAlias = tuple[int, Floats]  # media time; samples, (n, channels)


class ReplayWindow:
    """Tracks the audio messages that a replacement recognizer would need."""

    def __init__(self) -> None:
        self.last_droppable_sequence = 0  # last message that a replacement can do without
        self._final = FinalTimeTracker()  # final time of the messages that the synthesizer has
        # (sequence, end) of each message
        self._messages: deque[tuple[int, int]] = deque(maxlen=MAX_KEPT_MESSAGES)

    def add(self, sequence: int, end: int) -> None:
        """Add an audio message that ends at a media time in samples."""
        self._messages.append((sequence, end))

    def update(self, result: Message, newest_sequence: int) -> None:
        """Drop the messages that are no longer needed, because the synthesizer has a result."""
        if isinstance(result, speech.Progress) and result.state == speech.AudioState.ENDED:
            self.last_droppable_sequence = newest_sequence
            return
        self._final.update(result)
        needed_from = max(0, self._final.media_time - to_samples(WARM_UP_S))
        while self._messages and self._messages[0][1] <= needed_from:
            self.last_droppable_sequence, _ = self._messages.popleft()


class ResumeFilter:
    """Drops results before ``time_s``, which are already known. The middle of a phone counts."""

    def __init__(self, time_s: float) -> None:
        self._time_s = time_s
        self._emitted: set[int] = set()  # indices of phones that were emitted, not yet final
        self._is_speaking = False  # at ``time_s``, if known
        self._is_aligned = False
        self._has_emitted = False

    def align(self, chunk: Chunk, sample_rate_hz: int) -> Chunk:
        """Drop the audio before the first multiple of ``GRID_S``; the result may be empty."""
        media_time, samples = chunk
        if self._is_aligned:
            return chunk
        num_skipped = -media_time % round(GRID_S * MEDIA_RATE_HZ)
        begin = min(len(samples), -(-num_skipped * sample_rate_hz // MEDIA_RATE_HZ))
        self._is_aligned = begin < len(samples)
        return media_time + begin * MEDIA_RATE_HZ // sample_rate_hz, samples[begin:]

    def new_results(self, results: Iterable[StreamOutput]) -> list[StreamOutput]:
        """Return a stream's new results, preceded by the state of the voice activity."""
        emitted: list[StreamOutput] = []
        for result in results:
            new = self._trim(result)
            if new is None:
                continue
            if not self._has_emitted:
                self._has_emitted = True
                emitted.append(SpeechChange(active=self._is_speaking, time_s=self._time_s))
            emitted.append(new)
        return emitted

    def _trim(self, result: StreamOutput) -> StreamOutput | None:
        match result:
            case Phone():
                return self._trim_phone(result)
            case SpeechChange():
                return self._trim_change(result)
            case Waveform():
                return self._trim_waveform(result)
            case Progress() if result.time_s <= self._time_s:
                return None
            case LipPositions() if result.time_s < self._time_s:
                return None
        return result

    def _trim_change(self, change: SpeechChange) -> SpeechChange | None:
        if not self._has_emitted and change.time_s <= self._time_s:
            self._is_speaking = change.active
            return None
        return replace(change, time_s=max(change.time_s, self._time_s))

    def _trim_waveform(self, waveform: Waveform) -> Waveform | None:
        num_known = max(0, to_samples(self._time_s) - to_samples(waveform.time_s))
        if num_known == 0:
            return waveform
        samples = waveform.samples[num_known:]
        return Waveform(time_s=self._time_s, samples=samples) if len(samples) else None

    def _trim_phone(self, phone: Phone) -> Phone | None:
        """Return a new phone. An emitted phone that turns out to be known is withdrawn for good."""
        is_new = phone.onset_s + phone.duration_s / 2 >= self._time_s
        was_emitted = phone.index in self._emitted
        if phone.final:
            self._emitted.discard(phone.index)
        elif is_new:
            self._emitted.add(phone.index)
        if is_new or (was_emitted and not phone.final):
            return phone
        return replace(phone, symbol=SILENCE, duration_s=0.0) if was_emitted else None
