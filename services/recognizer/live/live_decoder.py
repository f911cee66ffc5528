"""Live decoding: turns score events into phones, with first hypotheses and corrections.

Source: Li et al. 2011, sections 1 and 2.2.

The shortest delay from a phone's onset to its first hypothesis is
25 ms window + L * 10 ms + (N - 1) * 10 ms. L is the acoustic model's look-ahead in frames, and N is
``num_stable_frames``. The block network runs every 40 ms, so L is 1 to 4. When speech starts, the
VAD adds up to 60 ms. For input above 16 kHz, the resampler adds 2 ms. The paper has N = 3 and
differences that look 40 ms ahead, so its delay is 85 ms. The paper states 45 ms, because it leaves
out the differences.
"""

from collections.abc import Iterable
from typing import TypeAlias

import numpy as np

from kouxing.services.recognizer.acoustic.acoustic_model import (
    AFTER_PAUSE,
    WITHIN_PHRASE,
    Topology,
    empty_scores,
)
from kouxing.services.recognizer.front_end.features import frame_time_s
from kouxing.services.recognizer.live.speech_scorer import FrameScores, ScoreEvent
from kouxing.services.recognizer.live.speech_segmenter import SpeechEnd, SpeechStart
from kouxing.services.recognizer.search.decoder import Decoder, PathSegment
from kouxing.services.recognizer.search.output_rule import OutputRule, OutputRuleConfig
from kouxing.shared.arrays import Floats
from kouxing.shared.fast_record import replace
from kouxing.shared.phones.events import Phone, SoundEvent, SpeechChange, Waveform

_DEFAULT_CONFIDENCE = 0.5  # confidence of a phone that was not emitted before it was final

StreamOutput: TypeAlias = SoundEvent | Waveform


class LiveDecoder:
    """Recognizes phones in score events.

    A phone is first emitted with ``final`` false and its mean duration, as soon as the output rule
    allows (Li 2011, eq. 4). There is a mean after a pause and one inside a phrase. It is still
    unknown whether a pause follows, which would lengthen the phone.

    The paper never corrects an emitted phone. Here, whenever a phone is emitted, the best string
    corrects the earlier ones. Such a phone is emitted again under its ``index``, with the measured
    onset and duration, or with another symbol. Phones that the rule passed over are emitted
    together with the next one. An extra phone is withdrawn (``Phone.is_withdrawn``). Silence
    within speech is also a phone.

    A phone is final when all paths of the search over settled scores share it, or speech has ended.
    The final phones therefore equal offline decoding. Their confidence is the mean over
    their frames. The output rule and the provisional scores affect neither.

    If the model has provisional scores, the search continues over them. When the next scores
    arrive, it restarts from the last settled frame. The output rule processes each frame once, as
    soon as the frame has a score of either kind. Phones are therefore emitted early, and better
    scores correct them.
    """

    def __init__(self, topology: Topology, rule: OutputRuleConfig) -> None:
        self._topology = topology
        self._inventory = topology.inventory
        self._silence = self._inventory.index[self._inventory.silence]
        self._settled = Decoder(topology)  # the search over settled scores
        # continuation of that search over provisional scores, if any
        self._provisional_decoder: Decoder | None = None
        self._rule = OutputRule(rule, last_emitted=self._silence)
        self._num_final = 0
        self._start_speech(0)

    def decode(self, events: Iterable[ScoreEvent]) -> list[StreamOutput]:
        """Return the phones and speech changes of the next events, and other events unchanged."""
        out: list[StreamOutput] = []
        for event in events:
            if isinstance(event, SpeechStart):
                self._start_speech(event.frame)
                out.append(SpeechChange(active=True, time_s=frame_time_s(event.frame)))
            elif isinstance(event, SpeechEnd):
                path = self._settled.final_path()
                rest = [segment for segment in path if segment.start >= self._final_end_frame]
                if self._open and len(rest) > 1 and rest[-1].phone == self._silence:
                    rest.pop()  # the end of speech implies it
                out += self._revise(rest, num_following=0)
                out.append(SpeechChange(active=False, time_s=frame_time_s(event.frame)))
            elif isinstance(event, FrameScores):
                out += self._decode_frames(event)
            else:
                out.append(event)
        return out

    def _start_speech(self, frame: int) -> None:
        self._start_frame = frame
        self._final_end_frame = 0  # the decoder's frame up to which phones are final
        self._num_checked = 0  # frames that the output rule has processed
        # confidence of the settled frames from ``_final_end_frame`` on
        self._confidence = np.empty(0)
        self._provisional = empty_scores(self._topology.num_states)  # scores of the last search
        self._settled.reset()
        self._decoder = self._settled
        self._rule.reset()
        self._last_final = self._silence  # index of the last final phone
        self._open: list[Phone] = []  # emitted, not yet final

    def _decode_frames(self, scores: FrameScores) -> list[Phone]:
        known, self._provisional = self._provisional, scores.provisional
        if len(scores.settled) or not np.array_equal(known, scores.provisional[: len(known)]):
            known = known[:0]  # the search over provisional scores restarts
        self._decoder = self._settled
        out = self._search(scores.settled)
        if len(scores.settled):
            self._settled.forget_before(self._final_end_frame)
            self._settled.drop_records()
        if len(scores.provisional):
            self._provisional_decoder = self._decoder = self._provisional_decoder or Decoder(
                self._topology
            )
            if not len(known):
                self._decoder.copy_state(self._settled)
            out += self._search(scores.provisional[len(known) :])
        return out

    def _search(self, scores: Floats) -> list[Phone]:
        """Continue the search; the output rule processes each frame only once."""
        num_checked = max(0, self._num_checked - self._decoder.num_frames)
        confidence = [self._decoder.advance(scores[:num_checked])] if num_checked else []
        out: list[Phone] = []
        scores = scores[num_checked:]
        while len(scores):
            phones, newest = self._decoder.advance_until(
                scores, self._rule.last_emitted, self._rule.min_confidence
            )
            confidence.append(newest)
            scores = scores[len(phones) :]
            self._num_checked = self._decoder.num_frames
            # Only the last of these frames may emit a phone.
            emits = [
                self._rule.update(*frame)
                for frame in zip(phones.tolist(), newest.tolist(), strict=True)
            ]
            if emits[-1]:
                out += self._emit_phone()
        if self._decoder is self._settled:
            self._confidence = np.concatenate([self._confidence, *confidence])
        return out

    def _emit_phone(self) -> list[Phone]:
        """Return the last phone and corrections."""
        phone, start, confidence = self._decoder.last_phone
        revised = self._revise(self._decoder.path_since(self._final_end_frame), num_following=1)
        index = self._inventory.index
        before = index[self._open[-1].symbol] if self._open else self._last_final
        position = AFTER_PAUSE if before == self._silence else WITHIN_PHRASE
        new = Phone(
            index=self._num_final + len(self._open),
            symbol=self._inventory.phones[phone],
            onset_s=self._time_s(max(start, self._final_end_frame)),
            duration_s=float(self._topology.duration_mean_s[position, phone]),
            confidence=confidence,
            final=False,
        )
        self._open.append(new)
        return [*revised, new]

    def _revise(self, segments: list[PathSegment], num_following: int) -> list[Phone]:
        """Replace the open phones with the best string; return the new and changed phones.

        ``num_following`` phones follow the segments: one, or none if speech has ended.
        """
        num_before = len(self._open) - num_following
        is_first = self._final_end_frame == 0 and len(segments) > max(0, num_before)
        if is_first and segments[0].phone == self._silence:
            segments = segments[1:]  # silence before the first phone is not emitted
        emitted = self._withdraw(max(0, num_before - len(segments)))
        final_until = self._settled.shared_end if num_following else self._settled.num_frames
        known = dict(enumerate(self._open))
        self._open = []
        first_index, first_frame = self._num_final, self._final_end_frame
        for number, segment in enumerate(segments):
            known_phone = known.get(number)
            onset_s = self._time_s(segment.start)
            is_final = segment.end <= final_until
            if is_final:
                span = slice(segment.start - first_frame, segment.end - first_frame)
                confidence = float(self._confidence[span].mean())
            else:
                confidence = known_phone.confidence if known_phone else _DEFAULT_CONFIDENCE
            phone = Phone(
                index=first_index + number,
                symbol=self._inventory.phones[segment.phone],
                onset_s=onset_s,
                duration_s=self._time_s(segment.end) - onset_s,
                confidence=confidence,
                final=is_final,
            )
            if phone != known_phone:
                emitted.append(phone)
            if is_final:
                self._num_final += 1
                self._last_final = segment.phone
                self._final_end_frame = segment.end
            else:
                self._open.append(phone)
        self._confidence = self._confidence[self._final_end_frame - first_frame :]
        return emitted

    def _withdraw(self, num_phones: int) -> list[Phone]:
        """Return the first open phones as withdrawn: the best string has fewer phones."""
        silence = self._inventory.silence
        withdrawn = [
            replace(phone, symbol=silence, duration_s=0.0, final=True)
            for phone in self._open[:num_phones]
        ]
        del self._open[:num_phones]
        self._num_final += num_phones
        return withdrawn

    def _time_s(self, frame: int) -> float:
        """Media time of the decoder's frame."""
        return frame_time_s(self._start_frame + frame)
