"""Sound in, phones out, live: the recognizer without sockets.

    samples -> speech scores -> Viterbi search -> output rule

Source: Li et al. 2011, sections 1 and 2.2.

The least delay from a phone's onset to its first hypothesis is
25 ms window + L * 10 ms + (N - 1) * 10 ms, where L is the acoustic model's look-ahead in frames (1
by default) and N is ``num_stable_frames`` (1 by default): 35 ms. A neural model scores two frames
at a time, so half of the frames come 10 ms sooner. The paper, with N = 3 and differences that look
40 ms ahead, leaves these out: it states 45 ms, in truth 85. At the beginning of speech the voice
detector adds up to 32 ms; for input above 16 kHz the resampler adds 2 ms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import (
    FIRST,
    INSIDE,
    AcousticModel,
    ScoringTask,
    no_scores,
    run_scoring_tasks,
)
from kouxing.services.recognizer.front_end.features import HOP_S, SAMPLE_RATE_HZ
from kouxing.services.recognizer.front_end.vad import BLOCK_SAMPLES, VoiceActivityDetector
from kouxing.services.recognizer.lip_source import LipFrameStream
from kouxing.services.recognizer.search.decoder import Decoder, Segment, segments_after
from kouxing.services.recognizer.search.output_rule import OutputRule
from kouxing.services.recognizer.speech_scores import (
    FrameScores,
    ScoreEvent,
    SpeechEnd,
    SpeechScores,
    SpeechStart,
    frame_time_s,
)
from kouxing.shared.phones.events import LipFrame, Phone, SpeechChange

DEFAULT_RULE = (1, 0.9)  # N (the paper's is 3) and the confidence that each frame needs
FINALIZE_AFTER_S = 0.2  # after a phone's end; waiting longer corrects nothing more
_FINALIZE_AFTER_FRAMES = round(FINALIZE_AFTER_S / HOP_S)
_WARM_UP_S = 0.2
_WARM_UP_ROWS = 200  # of equal scores: so many paths stay alive that the search drops records
_DEFAULT_CONFIDENCE = 0.5  # of a phone that was not emitted before it was final

Emission: TypeAlias = Phone | LipFrame | SpeechChange


class Recognizer:
    """Recognises phones live.

    A phone is first emitted with ``final`` false and its mean duration, as soon as the output rule
    allows (Li 2011, eq. 4). There is a mean after a pause and one inside a phrase; nobody can know
    yet whether the phone is the last before a pause, and longer.

    The paper never corrects an emitted phone. Here the best string corrects it whenever a phone is
    emitted: the ``index`` comes again with the measured onset and duration, or with another symbol
    if the search has changed its mind. Phones that the rule passed over are emitted together with
    the next one; one too many is withdrawn (``Phone.is_withdrawn``). A phone comes for the last
    time, with ``final`` true, ``FINALIZE_AFTER_S`` after its end or when speech ends. Silence
    within speech is a phone like any other.

    Where the model has provisional scores, the search runs on over them, and starts again from the
    last settled frame when the next scores come. The output rule hears each frame once, as soon as
    it has a score of either kind. So phones come early, and are corrected by better scores.

    Parameters
    ----------
    model
        The acoustic model, shared by any number of recognizers.
    sample_rate_hz
        Rate of the input, 8000 to 48000.
    num_channels
        Channels of the input; they are averaged.
    num_stable_frames
        N of the output rule.
    min_confidence
        Confidence that a frame needs to count for the output rule; 0 is the paper's rule.
    lips
        The session's lips, if lip frames are to be emitted; their model's streams must be
        ``PositionStream``s.
    under_way
        Frame at which speech began that another recognizer has begun, as in ``SpeechScores``.

    Raises
    ------
    UserError
        If the rate or the channels are out of range.

    Examples
    --------
    >>> recognizer = Recognizer(load_model(), sample_rate_hz=48_000)
    >>> for chunk in microphone:
    ...     events = recognizer.accept_waveform(chunk)
    """

    def __init__(
        self,
        model: AcousticModel,
        *,
        sample_rate_hz: int,
        num_channels: int = 1,
        num_stable_frames: int = DEFAULT_RULE[0],
        min_confidence: float = DEFAULT_RULE[1],
        lips: LipFrameStream | None = None,
        under_way: int | None = None,
    ) -> None:
        self._model = model
        self._symbols = model.inventory.phones
        self._silence = model.inventory.index[model.inventory.silence]
        self._durations_s = model.topology.duration_mean_s
        self._scores = SpeechScores(model, sample_rate_hz, num_channels, lips, under_way)
        self._settled = Decoder(model.topology)  # the search over settled scores
        self._ahead: Decoder | None = None  # the same, and on over provisional ones, if they come
        self._rule = OutputRule(num_stable_frames, min_confidence, last_emitted=self._silence)
        self._num_final = 0
        self._start_speech(0)

    @property
    def time_s(self) -> float:
        """Media time up to which the sound has been recognised."""
        return self._scores.num_frames_done * HOP_S

    def accept_waveform(self, samples: NDArray[np.float32]) -> list[Emission]:
        """Take sound.

        Parameters
        ----------
        samples
            Shape (n,) or (n, channels), in [-1, 1], at the input's rate.

        Returns
        -------
        list
            New events, in the order of media time.

        Raises
        ------
        UserError
            If the samples have another shape or are not finite.
        """
        return run_scoring_tasks(self._model, [self.process(samples)])[0]

    def input_finished(self) -> list[Emission]:
        """End the sound; return the remaining events."""
        return run_scoring_tasks(self._model, [self.finish()])[0]

    def reset(self) -> None:
        """Start a new session: the clock at 0, the speaker unknown."""
        self._scores.reset()
        self._start_speech(0)
        self._num_final = 0

    def process(self, samples: NDArray[np.float32]) -> ScoringTask[list[Emission]]:
        """Like :meth:`accept_waveform`, as a task that runs beside other sessions'."""
        return self.decode((yield from self._scores.process(samples)))

    def finish(self) -> ScoringTask[list[Emission]]:
        """Like :meth:`input_finished`, as a task that runs beside other sessions'."""
        return self.decode((yield from self._scores.finish()))

    def decode(self, events: Sequence[ScoreEvent]) -> list[Emission]:
        """Take the events of :class:`SpeechScores` in order; return the new events."""
        out: list[Emission] = []
        for event in events:
            if isinstance(event, LipFrame):
                out.append(event)
            elif isinstance(event, SpeechStart):
                self._start_speech(event.frame)
                out.append(SpeechChange(active=True, time_s=frame_time_s(event.frame)))
            elif isinstance(event, SpeechEnd):
                rest = segments_after(self._decoder.finish(), self._done)
                if self._open and len(rest) > 1 and rest[-1].phone == self._silence:
                    rest.pop()  # the end of speech stands for it
                out += self._revise(rest, num_following=0)
                out.append(SpeechChange(active=False, time_s=frame_time_s(event.frame)))
            else:
                out += self._decode_frames(event)
        return out

    def _start_speech(self, frame: int) -> None:
        self._start_frame = frame
        self._done = 0  # the decoder's frame up to which phones are final
        self._num_heard = 0  # frames that the output rule has heard
        self._provisional = no_scores(self._model.topology.num_states)  # that were searched last
        self._settled.reset()
        self._decoder = self._settled
        self._rule.reset()
        self._last_final = self._silence  # index of the last final phone
        self._open: list[Phone] = []  # emitted, not yet final

    def _decode_frames(self, scores: FrameScores) -> list[Phone]:
        known, self._provisional = self._provisional, scores.provisional
        if len(scores.settled) or not np.array_equal(known, scores.provisional[: len(known)]):
            known = known[:0]  # else the search ahead goes on where it stands
        self._decoder = self._settled
        out = self._search(scores.settled)
        if len(scores.provisional):
            self._ahead = self._decoder = self._ahead or Decoder(self._model.topology)
            if not len(known):
                self._settled.forget_before(self._done)
                self._decoder.go_on_from(self._settled)
            out += self._search(scores.provisional[len(known) :])
        return out

    def _search(self, scores: NDArray[np.float32]) -> list[Phone]:
        """Let the search go on over frames; the output rule hears those that it has not heard."""
        num_heard = max(0, self._num_heard - self._decoder.num_frames)
        self._decoder.advance(scores[:num_heard])
        return [phone for row in scores[num_heard:] for phone in self._decode_frame(row)]

    def _decode_frame(self, scores: NDArray[np.float32]) -> list[Phone]:
        phone, start, confidence = self._decoder.accept(scores)
        self._num_heard = self._decoder.num_frames
        if not self._rule.accept(phone, confidence):
            return []
        revised = self._revise(self._decoder.path_since(self._done), num_following=1)
        before = self._index_of(self._open[-1]) if self._open else self._last_final
        position = FIRST if before == self._silence else INSIDE
        new = Phone(
            index=self._num_final + len(self._open),
            symbol=self._symbols[phone],
            onset_s=self._time_s(max(start, self._done)),
            duration_s=float(self._durations_s[position, phone]),
            confidence=confidence,
            final=False,
        )
        self._open.append(new)
        return [*revised, new]

    def _revise(self, segments: list[Segment], num_following: int) -> list[Phone]:
        """Replace the open phones by the best string; return those that are new or changed.

        ``num_following`` phones come after the segments: one, unless speech has ended.
        """
        num_before = len(self._open) - num_following
        is_first = self._done == 0 and len(segments) > max(0, num_before)
        if is_first and segments[0].phone == self._silence:
            segments = segments[1:]  # silence before the first phone is not emitted
        emitted: list[Phone] = []
        while len(segments) < num_before:  # a phone too many was emitted: it is withdrawn
            silence = self._symbols[self._silence]
            emitted.append(replace(self._open.pop(0), symbol=silence, duration_s=0.0, final=True))
            self._num_final, num_before = self._num_final + 1, num_before - 1
        final_until = self._decoder.num_frames - (_FINALIZE_AFTER_FRAMES if num_following else 0)
        known = dict(enumerate(self._open))
        self._open = []
        first_index = self._num_final
        for number, segment in enumerate(segments):
            onset_s = self._time_s(segment.start)
            phone = Phone(
                index=first_index + number,
                symbol=self._symbols[segment.phone],
                onset_s=onset_s,
                duration_s=self._time_s(segment.end) - onset_s,
                confidence=known[number].confidence if number in known else _DEFAULT_CONFIDENCE,
                final=segment.end <= final_until,
            )
            if phone != known.get(number):
                emitted.append(phone)
            if phone.final:
                self._finalize(phone)
            else:
                self._open.append(phone)
        return emitted

    def _finalize(self, phone: Phone) -> None:
        """Count a phone as final."""
        self._num_final += 1
        self._last_final = self._index_of(phone)
        end_s = phone.onset_s + phone.duration_s - self._time_s(0)
        self._done = round(end_s / HOP_S)

    def _index_of(self, phone: Phone) -> int:
        """Position of a phone's symbol in the inventory."""
        return self._model.inventory.index[phone.symbol]

    def _time_s(self, frame: int) -> float:
        """Media time of the decoder's frame."""
        return frame_time_s(self._start_frame + frame)


def warm_up(model: AcousticModel) -> None:
    """Run everything once, so that a session's first chunk does not wait for the compiler."""
    stream, decoder = model.stream(), Decoder(model.topology)
    silence = np.zeros(round(_WARM_UP_S * SAMPLE_RATE_HZ), dtype=np.float32)
    frames = model.front_end().accept_waveform(silence)
    scores = np.concatenate([stream.accept(frames), stream.finish()])
    decoder.advance(scores)
    decoder.advance(np.zeros((_WARM_UP_ROWS, scores.shape[1]), dtype=np.float32))
    decoder.finish()
    VoiceActivityDetector().accept_block(np.zeros(BLOCK_SAMPLES, dtype=np.float32))
