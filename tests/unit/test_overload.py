"""A live session that falls behind skips old audio; unpaced audio is complete."""

from collections.abc import Callable

import numpy as np
import pytest

from kouxing.services.recognizer.sessions.audio_queue import AudioQueue
from kouxing.shared.service.overload import (
    CATCH_UP_S,
    GRACE_PERIOD_S,
    LIGHT_MODEL_HOLD_S,
    SkipPolicy,
)

MAX_LAG_S = 0.2
CHUNK_S = 0.02
RATE_HZ = 16_000


class Session:
    """A session of a service that processes audio at a speed, in steps of 20 ms."""

    def __init__(self, **options: float) -> None:
        self.overload = SkipPolicy(MAX_LAG_S, **options)
        self.now_s = 100.0
        self.waiting_s = -CHUNK_S  # after the oldest chunk

    def run(self, duration_s: float, speed: float, sent: float = 1.0) -> list[bool]:
        """Receive audio at a rate and process it at another; return when audio is skipped."""
        skips = []
        for _ in range(round(duration_s / CHUNK_S)):
            self.now_s += CHUNK_S
            if sent:
                self.receive(sent * CHUNK_S)
            skips.append(self.overload.update(max(0.0, self.waiting_s), self.now_s))
            self.waiting_s = 0.0 if skips[-1] else max(-CHUNK_S, self.waiting_s - speed * CHUNK_S)
        return skips

    def receive(self, duration_s: float) -> None:
        self.overload.add(duration_s, self.now_s, has_queued=self.waiting_s >= 0.0)
        self.waiting_s += duration_s


def test_a_slow_service_skips_audio_that_it_cannot_process() -> None:
    session = Session()
    assert any(session.run(30.0, speed=0.5))
    assert session.overload.skipped_s == pytest.approx(0.5 * 30.0, abs=1.0)
    session.run(1.0, speed=3.0)  # the remaining queued audio
    assert not any(session.run(4.0, speed=3.0))


def test_a_session_is_never_far_behind_for_long() -> None:
    session = Session()
    behind_s = []
    for _ in range(2000):
        session.run(CHUNK_S, speed=0.3)
        behind_s.append(session.waiting_s)
    assert max(behind_s) < MAX_LAG_S + GRACE_PERIOD_S


def test_skips_audio_that_arrived_while_the_process_was_stopped() -> None:
    session = Session()
    session.run(2.0, speed=3.0)
    session.now_s += 10.0
    for _ in range(500):
        session.receive(CHUNK_S)
    assert session.run(CHUNK_S, speed=3.0) == [True]
    assert session.overload.skipped_s == pytest.approx(10.0, abs=0.1)


def _send_ahead(session: Session) -> None:
    for _ in range(200):
        session.receive(CHUNK_S)


def _send_after_a_pause(session: Session) -> None:
    session.run(2.0, speed=3.0)
    session.now_s += 10.0
    session.overload.resume()
    _send_ahead(session)


def _send_a_long_chunk(session: Session) -> None:
    session.run(2.0, speed=3.0)
    session.now_s += 2.0
    session.receive(2.0)
    session.waiting_s = 0.0


@pytest.mark.parametrize("send", [_send_ahead, _send_after_a_pause, _send_a_long_chunk])
def test_audio_that_is_not_late_is_kept(send: Callable[[Session], None]) -> None:
    session = Session()
    send(session)
    assert not any(session.run(4.0, speed=1.3, sent=0.0))


def test_a_late_first_chunk_does_not_hide_lateness() -> None:
    session = Session()
    session.receive(CHUNK_S)
    session.now_s -= 0.5  # the following chunks arrive half a second earlier
    session.run(1.0, speed=3.0)
    assert any(session.run(2.0, speed=0.3))


def test_a_session_that_moved_may_catch_up_first() -> None:
    session = Session(start_s=100.0 + CATCH_UP_S)
    _send_ahead(session)
    assert not any(session.run(CATCH_UP_S - 0.1, speed=0.5))
    assert any(session.run(1.0, speed=0.5))


def test_a_slower_network_is_not_overload() -> None:
    session = Session()
    session.run(2.0, speed=3.0)
    session.now_s += 1.0  # from now on, all audio arrives later
    for _ in range(100):
        session.overload.adapt(session.now_s)
    assert not session.overload.is_late(session.now_s)


def test_reports_skipped_audio_at_most_once_a_second() -> None:
    session = Session()
    reports_s = []
    for _ in range(500):
        session.run(CHUNK_S, speed=0.1)
        reports_s.append(session.overload.take_report_s(session.now_s))
    assert 8 <= np.count_nonzero(reports_s) <= 10
    assert sum(reports_s) == pytest.approx(session.overload.skipped_s, abs=1.0)


def test_live_audio_is_taken_in_parts_and_cut_to_the_newest_chunk() -> None:
    audio = AudioQueue(2 * RATE_HZ, SkipPolicy(MAX_LAG_S))
    chunk = np.zeros((3200, 1), np.float32)  # 0.1 s
    audio.append((0, chunk), 0.0)
    audio.append((1600, chunk), 0.1)
    taken = list(audio.take(0.15))
    assert [(at, len(samples)) for at, samples in taken] == [(0, 3200), (1600, 1600)]
    assert audio.duration_s == pytest.approx(0.05)
    assert not audio.skip_old(0.1)
    for number in range(2, 20):
        audio.append((1600 * number, chunk), 2.0)
    assert not audio.is_outdated(2.0)
    assert audio.is_outdated(3.0)
    assert audio.skip_old(2.0)
    assert [at for at, _ in audio.take(1.0)] == [1600 * 19]
    assert not audio


def test_empty_chunks_fill_the_queue() -> None:
    audio = AudioQueue(RATE_HZ, SkipPolicy(MAX_LAG_S))
    for _ in range(100):
        audio.append((0, np.zeros((0, 1), np.float32)), 0.0)
    assert audio.duration_s == pytest.approx(0.1)
    assert len(list(audio.take(0.05))) == 50


def test_a_session_that_is_slightly_behind_uses_the_light_model() -> None:
    session = Session()
    session.run(2.0, speed=3.0)
    assert not session.overload.needs_light_model(session.now_s)
    session.run(1.0, speed=0.8)
    assert session.overload.needs_light_model(session.now_s)
    assert session.overload.skipped_s == 0.0
    session.run(LIGHT_MODEL_HOLD_S + 1.0, speed=3.0)
    assert not session.overload.needs_light_model(session.now_s)


def test_the_hop_rises_before_the_light_model_is_used() -> None:
    session = Session()
    session.run(2.0, speed=3.0)
    assert not session.overload.is_behind
    while not session.overload.needs_light_model(session.now_s):
        was_behind = session.overload.is_behind
        session.run(CHUNK_S, speed=0.8)
    assert was_behind
