"""Live streams for tests: every call returns the recognizer's new results."""

from typing import Any

import numpy as np
from kouxing_client.messages import SessionFacts
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.live.live_decoder import StreamOutput
from kouxing.services.recognizer.live.recognizer import Recognizer
from kouxing.services.recognizer.search.output_rule import OutputRuleConfig
from kouxing.shared.fast_record import replace
from tests.samples import START as START_AT_16_KHZ
from tests.samples import with_opening

START = replace(
    with_opening(START_AT_16_KHZ, sample_rate_hz=8000),
    facts=SessionFacts(language="mandarin", delay_ms=0.0),
)
RULE = OutputRuleConfig()


class LiveStream:
    """A stream with a separate recognizer; ``options`` are those of ``create_stream``."""

    def __init__(self, model: AcousticModel, rule: OutputRuleConfig = RULE, **options: Any) -> None:
        self._recognizer = Recognizer(model, rule)
        self.stream = self._recognizer.create_stream(**options)

    def feed(
        self, samples: NDArray[np.float32], media_time: int | None = None, chunk: int | None = None
    ) -> list[StreamOutput]:
        """Return the results after samples, in chunks of a size or at once."""
        size = chunk or max(1, len(samples))
        results = []
        for begin in range(0, len(samples), size):
            self.stream.accept_waveform(samples[begin : begin + size], media_time)
            media_time = None
            results += self.decode()
        return results

    def finish(self) -> list[StreamOutput]:
        """Return the results after the end of the audio."""
        self.stream.input_finished()
        return self.decode()

    def decode(self) -> list[StreamOutput]:
        """Return the results of the audio so far."""
        self._recognizer.decode_streams([self.stream])
        assert not any(scorer.has_speech for scorer in self.stream.scorers)
        return self.stream.take_results()


def recognize_live(
    model: AcousticModel,
    samples: NDArray[np.float32],
    chunk: int | None = None,
    rule: OutputRuleConfig = RULE,
    **options: Any,
) -> list[StreamOutput]:
    """Return all results of a recording."""
    stream = LiveStream(model, rule, **options)
    return stream.feed(samples, chunk=chunk) + stream.finish()


def recognize_together(
    model: AcousticModel, recordings: list[NDArray[np.float32]], **options: Any
) -> list[list[StreamOutput]]:
    """Return all results of recordings that are decoded together."""
    recognizer = Recognizer(model)
    streams = [recognizer.create_stream(**options) for _ in recordings]
    for stream, samples in zip(streams, recordings, strict=True):
        stream.accept_waveform(samples)
        stream.input_finished()
    recognizer.decode_streams(streams)
    return [stream.take_results() for stream in streams]
