"""Batches of live audio: what is decoded after a run of the block network."""

from collections.abc import Sequence
from typing import Any, cast

from kouxing.services.recognizer.live.recognizer import Recognizer
from kouxing.services.recognizer.sessions.live_batch_decoder import LiveBatchDecoder
from kouxing.services.recognizer.sessions.session import RecognizerSession
from kouxing.shared.monitoring.metrics import LoadMeter
from kouxing.shared.service.overload import SkipPolicy


class FakeAudio(list[int]):
    """Queued audio."""

    skip_policy = SkipPolicy(1.0, 0.0)


class FakeSession:
    """A session whose stream is itself, and whose audio ends during the run of the network."""

    def __init__(self) -> None:
        self.audio = FakeAudio([1])
        self.waits_for_network = self.is_scoring = False
        self.stream = self
        self.found: list[str] = []  # speech that is not decoded yet

    @property
    def is_decoding(self) -> bool:
        return bool(self.audio) or self.waits_for_network or self.is_scoring

    @property
    def can_accept(self) -> bool:
        return bool(self.audio)

    @property
    def needs_network(self) -> bool:
        return "needs the network" in self.found

    def accept_waveform(self, max_s: float, now_s: float, hop: int) -> None:
        assert max_s > 0.0 < now_s, hop
        self.audio.clear()
        self.found.append("needs the network")

    def begin_background_scoring(self) -> None:
        assert self.is_scoring

    def end_background_scoring(self) -> None:
        self.found.append("end of speech")


class FakeRecognizer:
    """Decodes what the streams have found."""

    def __init__(self) -> None:
        self.decoded: list[str] = []

    def detect_speech(self, streams: Sequence[FakeSession]) -> None:
        assert len(streams) == 1

    def decode_speech(self, streams: Sequence[FakeSession]) -> None:
        for stream in streams:
            self.decoded += stream.found
            stream.found.clear()


def test_speech_found_during_a_run_is_decoded_without_more_audio() -> None:
    recognizer, sent = FakeRecognizer(), list[Any]()
    session = cast(RecognizerSession, FakeSession())
    batches = LiveBatchDecoder(
        [session, session],
        cast(Recognizer, recognizer),
        LoadMeter(1.0, 0.0),
        wake=lambda: None,
        on_early=sent.append,
        on_decoded=lambda sessions: sent.extend((list(sessions), [*recognizer.decoded])),
        on_batch=lambda: None,
    )
    batches.decode_all([session])
    assert recognizer.decoded == ["needs the network", "end of speech"]
    assert sent[-2:] == [[session], recognizer.decoded]
