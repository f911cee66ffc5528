"""Sound in, units out: the recognizer without sockets.

    samples -> resampler -> the model's front end -> [in speech] acoustic model -> Viterbi ->
    output rule

Source: Li et al. 2011, sections 1 and 2.2.

Time is media time: seconds from the session's first sample. Feature frame ``t`` stands for the
10 ms around the middle of its window. A chunk of any size gives the same result as any other
cutting of the same sound: every step works on whole frames and whole detector blocks, in order.

Least delay of a unit after its onset, with ``L`` the frames that the acoustic model looks ahead (1,
unless another look-ahead is set) and ``N`` the agreement (1): 25 ms window + L * 10 ms +
(N - 1) * 10 ms = 35 ms. A neural model speaks every other frame, so half of the frames come 10 ms
sooner. The paper, with N = 3 and differences that look 40 ms ahead, leaves those
out: 45 ms, in truth 85. At the beginning of speech the voice detector adds its own 32 to 64 ms;
above 16 kHz the resampler adds about 10 ms.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.recognizer.acoustic_model import FIRST, INSIDE, AcousticModel, Listening, listen
from services.recognizer.decoder import Decoder, Segment, segments_after
from services.recognizer.features import HOP_S, SAMPLE_RATE_HZ, WINDOW_S
from services.recognizer.output_rule import OutputRule
from services.recognizer.resample import Resampler
from services.recognizer.vad import BLOCK_SAMPLES, VoiceActivityDetector
from shared.phones import SILENCE, UNIT_INDEX, UNITS, Phone, SpeechChange

PRE_ROLL_S = 0.20  # kept from before the detector is sure: first consonants are weak
_PRE_ROLL_FRAMES = round((PRE_ROLL_S + 2 * BLOCK_SAMPLES / SAMPLE_RATE_HZ) / HOP_S)
DEFAULT_RULE = (1, 0.9)  # N (the paper's is 3) and the confidence that each frame needs
SETTLED_S = 0.2  # a unit that ended so long ago is final; waiting longer corrects nothing more
_SETTLED_FRAMES = round(SETTLED_S / HOP_S)
_SIL = UNIT_INDEX[SILENCE]
_WARM_UP_S = 0.2
_WARM_UP_ROWS = 200  # that say nothing: so many paths stay that the search forgets once
_UNSEEN_CONFIDENCE = 0.5  # of a unit that was never put out before it was final


def frame_time_s(frame: int) -> float:
    """Time of the boundary before a feature frame: halfway between two windows' middles."""
    return frame * HOP_S + (WINDOW_S - HOP_S) / 2


@dataclass(frozen=True, slots=True)
class VoiceBegins:
    """Speech begins; its first scored frame is ``frame``."""

    frame: int


@dataclass(frozen=True, slots=True)
class VoiceEnds:
    """Speech has ended before ``frame``."""

    frame: int


ScoreEvent = VoiceBegins | VoiceEnds | NDArray[np.float32]


class SpeechScores:
    """State scores of the frames that are speech, in order, with its beginnings and ends.

    Parameters
    ----------
    model
        The acoustic model.
    sample_rate_hz
        Rate of the input, 8000 to 48000.
    num_channels
        Channels of the input.
    """

    def __init__(self, model: AcousticModel, sample_rate_hz: int, num_channels: int = 1) -> None:
        self._model = model
        self._stream = model.stream()
        self._resampler = Resampler(sample_rate_hz, num_channels)
        self._detector = VoiceActivityDetector()
        self._reset_frames()

    def _reset_frames(self) -> None:
        self._front_end = self._model.front_end()
        self._block = np.empty(0, dtype=np.float32)
        self._recent: deque[NDArray[np.float32]] = deque(maxlen=_PRE_ROLL_FRAMES)
        self._num_frames = 0
        self._speaking = False

    @property
    def num_frames_done(self) -> int:
        """Feature frames whose scores, if they are speech, have been returned."""
        return max(0, self._num_frames - self._stream.look_ahead_frames)

    def hear(self, samples: NDArray[np.float32]) -> Listening[list[ScoreEvent]]:
        """Take samples of shape (n,) or (n, channels); return what became known."""
        return (yield from self._hear(self._resampler.accept_waveform(samples)))

    def finish(self) -> Listening[list[ScoreEvent]]:
        """End the stream: what is still owed."""
        events = yield from self._hear(self._resampler.finish())
        return events + (yield from self.end_speech())

    def end_speech(self) -> Listening[list[ScoreEvent]]:
        """End the speech now, as if it had become quiet."""
        self._detector.quieten()
        return (yield from self._end()) if self._speaking else []

    def reset(self) -> None:
        """Start a new session: new clock, new speaker."""
        self._stream.reset()
        self._resampler.reset()
        self._detector.reset()
        self._reset_frames()

    def _hear(self, samples: NDArray[np.float32]) -> Listening[list[ScoreEvent]]:
        events: list[ScoreEvent] = []
        while len(samples):  # cut where the detector's blocks end, whatever the chunks are
            piece = samples[: BLOCK_SAMPLES - len(self._block)]
            samples = samples[len(piece) :]
            self._block = np.concatenate([self._block, piece])
            events += yield from self._frames(self._front_end.accept_waveform(piece))
            if len(self._block) == BLOCK_SAMPLES:
                events += yield from self._judge()
                self._block = self._block[:0]
        return events

    def _frames(self, frames: NDArray[np.float32]) -> Listening[list[ScoreEvent]]:
        """Take the front end's frames, shape (n, k)."""
        self._num_frames += len(frames)
        if not self._speaking:
            self._recent.extend(frames)
            return []
        return _if_any((yield self._stream, frames))

    def _judge(self) -> Listening[list[ScoreEvent]]:
        speech = self._detector.accept_block(self._block).is_speech
        if speech and not self._speaking:
            self._speaking = True
            begin = VoiceBegins(self._num_frames - len(self._recent))
            pre_roll = np.array(self._recent)
            self._recent.clear()
            return [begin, *_if_any((yield self._stream, pre_roll))]
        if self._speaking and not speech:
            return (yield from self._end())
        return []

    def _end(self) -> Listening[list[ScoreEvent]]:
        self._speaking = False
        return [*_if_any((yield self._stream, None)), VoiceEnds(self._num_frames)]


def _if_any(scores: NDArray[np.float32]) -> list[ScoreEvent]:
    return [scores] if len(scores) else []


class Recognizer:
    """Recognises units live.

    A unit is put out with ``final`` false and the unit's mean duration as soon as the output rule
    allows (Li 2011, eq. 4). The mean is that of a unit after a pause or of one inside a phrase;
    that a unit is the last before a pause, and longer, nobody can know yet.

    The paper leaves what was put out as it is. Here the best string corrects it whenever a unit is
    put out: the ``index`` comes again with the unit's measured onset and duration, or with another
    unit if the search has changed its mind. Units that the rule passed over are said along with
    the next one. A unit that ended ``SETTLED_S`` ago, or all when speech ends, come for the last
    time, with ``final`` true. ``sil`` within speech is a unit like any other.

    Parameters
    ----------
    model
        The acoustic model, shared by any number of recognizers.
    sample_rate_hz
        Rate of the input, 8000 to 48000.
    num_channels
        Channels of the input; they are averaged.
    agreement
        N of the output rule.
    least_confidence
        Confidence that a frame needs to count for the output rule; 0 is the paper's rule.

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
        agreement: int = DEFAULT_RULE[0],
        least_confidence: float = DEFAULT_RULE[1],
    ) -> None:
        self._durations_s = model.topology.duration_mean_s
        self._model = model
        self._scores = SpeechScores(model, sample_rate_hz, num_channels)
        self._decoder = Decoder(model.topology)
        self._rule = OutputRule(agreement, least_confidence, last_output=_SIL)
        self._num_final = 0
        self._begin(0)

    @property
    def time_s(self) -> float:
        """Media time up to which everything that can be said has been said."""
        return self._scores.num_frames_done * HOP_S

    def accept_waveform(self, samples: NDArray[np.float32]) -> list[Phone | SpeechChange]:
        """Take sound.

        Parameters
        ----------
        samples
            Shape (n,) or (n, channels), in [-1, 1], at the input's rate.

        Returns
        -------
        list
            What became known, in the order of media time.

        Raises
        ------
        UserError
            If the samples have another shape or are no numbers.
        """
        return listen(self._model, [self.hear(samples)])[0]

    def hear(self, samples: NDArray[np.float32]) -> Listening[list[Phone | SpeechChange]]:
        """Like :meth:`accept_waveform`, for :func:`listen` beside other sessions."""
        return self.follow((yield from self._scores.hear(samples)))

    def input_finished(self) -> list[Phone | SpeechChange]:
        """No more sound will come: return all that is still owed."""
        return listen(self._model, [self.hear_end()])[0]

    def hear_end(self) -> Listening[list[Phone | SpeechChange]]:
        """Like :meth:`input_finished`, for :func:`listen` beside other sessions."""
        return self.follow((yield from self._scores.finish()))

    def flush(self) -> list[Phone | SpeechChange]:
        """End the speech now (an interruption); the clock and the speaker's mean go on."""
        return self.follow(listen(self._model, [self._scores.end_speech()])[0])

    def reset(self) -> None:
        """Start a new session: the clock at 0, the speaker unknown."""
        self._scores.reset()
        self._begin(0)
        self._num_final = 0

    def _begin(self, frame: int) -> None:
        self._start_frame = frame
        self._done = 0  # frame of the decoder up to which units are final
        self._decoder.reset()
        self._rule.reset()
        self._before = _SIL  # the last final unit
        self._open: list[Phone] = []  # said, not yet final

    def follow(self, events: Sequence[ScoreEvent]) -> list[Phone | SpeechChange]:
        """Take scores that :class:`SpeechScores` has computed, in order; return what they say."""
        out: list[Phone | SpeechChange] = []
        for event in events:
            if isinstance(event, VoiceBegins):
                self._begin(event.frame)
                out.append(SpeechChange(active=True, time_s=frame_time_s(event.frame)))
            elif isinstance(event, VoiceEnds):
                rest = segments_after(self._decoder.finish(), self._done)
                if self._open and len(rest) > 1 and rest[-1].unit == _SIL:
                    rest.pop()  # the end of speech says it
                out += self._revise(rest, num_following=0)
                out.append(SpeechChange(active=False, time_s=frame_time_s(event.frame)))
            else:
                for row in event:
                    out += self._frame(row)
        return out

    def _frame(self, scores: NDArray[np.float32]) -> list[Phone | SpeechChange]:
        unit, start, confidence = self._decoder.accept(scores)
        if not self._rule.accept(unit, confidence):
            return []
        revised = self._revise(self._decoder.path_since(self._done), num_following=1)
        before = UNIT_INDEX[self._open[-1].unit] if self._open else self._before
        new = Phone(
            index=self._num_final + len(self._open),
            unit=UNITS[unit],
            onset_s=self._time_s(max(start, self._done)),
            duration_s=float(self._durations_s[FIRST if before == _SIL else INSIDE, unit]),
            confidence=confidence,
            final=False,
        )
        self._open.append(new)
        return [*revised, new]

    def _revise(self, segments: list[Segment], num_following: int) -> list[Phone]:
        """Put the units of the best string in the place of the open ones; say what is new of them.

        ``num_following`` units come after these: the last one, unless speech has ended.
        """
        num_before = len(self._open) - num_following
        if self._done == 0 and len(segments) > max(0, num_before) and segments[0].unit == _SIL:
            segments = segments[1:]  # before the first unit nothing but silence was said
        said: list[Phone] = []
        while len(segments) < num_before:  # one said too many: it stays
            said.append(replace(self._open.pop(0), final=True))
            self._settle(said[-1])
            segments, num_before = segments_after(segments, self._done), num_before - 1
        settled = self._decoder.num_frames - (_SETTLED_FRAMES if num_following else 0)
        known = dict(enumerate(self._open))
        self._open = []
        first_index = self._num_final
        for number, segment in enumerate(segments):
            onset_s = self._time_s(segment.start)
            phone = Phone(
                index=first_index + number,
                unit=UNITS[segment.unit],
                onset_s=onset_s,
                duration_s=self._time_s(segment.end) - onset_s,
                confidence=known[number].confidence if number in known else _UNSEEN_CONFIDENCE,
                final=segment.end <= settled,
            )
            if phone != known.get(number):
                said.append(phone)
            if phone.final:
                self._settle(phone)
            else:
                self._open.append(phone)
        return said

    def _settle(self, phone: Phone) -> None:
        """Take a unit as final."""
        self._num_final += 1
        self._before = UNIT_INDEX[phone.unit]
        end_s = phone.onset_s + phone.duration_s - self._time_s(0)
        self._done = round(end_s / HOP_S)

    def _time_s(self, frame: int) -> float:
        """Media time of a frame of the decoder."""
        return frame_time_s(self._start_frame + frame)


def warm_up(model: AcousticModel) -> None:
    """Run everything once, so that the first chunk of a session waits for no compiler."""
    stream, decoder = model.stream(), Decoder(model.topology)
    silence = np.zeros(round(_WARM_UP_S * SAMPLE_RATE_HZ), dtype=np.float32)
    frames = model.front_end().accept_waveform(silence)
    scores = np.concatenate([stream.accept(frames), stream.finish()])
    for row in (*scores, *np.zeros((_WARM_UP_ROWS, scores.shape[1]), dtype=np.float32)):
        decoder.accept(row)
    decoder.finish()
    VoiceActivityDetector().accept_block(np.zeros(BLOCK_SAMPLES, dtype=np.float32))


def recognize(
    model: AcousticModel, samples: NDArray[np.float32], sample_rate_hz: int
) -> list[Phone]:
    """Recognise a whole recording with the full traceback (no output rule, nothing provisional).

    Parameters
    ----------
    model
        The acoustic model.
    samples
        Shape (n,) or (n, channels), in [-1, 1].
    sample_rate_hz
        Their rate.

    Returns
    -------
    list of Phone
        Units of all stretches of speech with their onsets and durations, ``sil`` included.
    """
    return full_traceback(model, scores_of(model, samples, sample_rate_hz))


def scores_of(
    model: AcousticModel, samples: NDArray[np.float32], sample_rate_hz: int
) -> list[ScoreEvent]:
    """Score a whole recording, of shape (n,) or (n, channels)."""
    num_channels = 1 if samples.ndim == 1 else samples.shape[1]
    scores = SpeechScores(model, sample_rate_hz, num_channels)
    return listen(model, [scores.hear(samples)])[0] + listen(model, [scores.finish()])[0]


def full_traceback(model: AcousticModel, events: Iterable[ScoreEvent]) -> list[Phone]:
    """Like :func:`recognize`, from all scores of a recording."""
    decoder = Decoder(model.topology)
    phones: list[Phone] = []
    offset = 0
    sureness: list[float] = []
    for event in events:
        if isinstance(event, VoiceBegins):
            offset = event.frame
            decoder.reset()
            sureness = []
        elif isinstance(event, VoiceEnds):
            for segment in decoder.finish():
                onset_s = frame_time_s(offset + segment.start)
                phones.append(
                    Phone(
                        index=len(phones),
                        unit=UNITS[segment.unit],
                        onset_s=onset_s,
                        duration_s=frame_time_s(offset + segment.end) - onset_s,
                        confidence=float(np.mean(sureness[segment.start : segment.end])),
                        final=True,
                    )
                )
        else:
            sureness += [decoder.accept(row)[2] for row in event]
    return phones
