"""The block network runs less often on an overloaded recognizer."""

import pytest

from kouxing.services.recognizer.sessions.hop_controller import (
    HOP_PERIOD_S,
    MAX_HOP_BLOCKS,
    RESTORE_AFTER_S,
    HopController,
    ProcessorTime,
)

CHUNK_S = 0.02


class Recognizer:
    """A recognizer whose network takes a share of the time, in inverse proportion to the hop."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self._work = ProcessorTime(other_s=3.0)  # the start of the service
        self.controller = HopController(self._work, self.now_s)

    def run(
        self, duration_s: float, others: float, network: float, *, is_behind: bool = False
    ) -> list[int]:
        """Work with a load of the network at hop 1, and one of the rest; return the hops."""
        hops = []
        for _ in range(round(duration_s / CHUNK_S)):
            self.now_s += CHUNK_S
            done = ProcessorTime(network * CHUNK_S / self.controller.hop, others * CHUNK_S)
            self._work += done
            hops.append(self.controller.update(self._work, self.now_s, is_behind=is_behind))
        return hops


@pytest.mark.parametrize(
    ("network", "hop"), [(0.1, 1), (0.25, 1), (0.5, 2), (0.8, 3), (1.1, 4), (1.7, 6), (9.0, 6)]
)
def test_the_network_runs_less_often_under_load(network: float, hop: int) -> None:
    hops = Recognizer().run(20.0, others=0.3, network=network)
    assert set(hops[round(2 * HOP_PERIOD_S / CHUNK_S) :]) == {hop}


def test_the_hop_falls_some_time_after_the_load() -> None:
    recognizer = Recognizer()
    recognizer.run(5.0, others=0.3, network=1.1)
    hops = recognizer.run(20.0, others=0.2, network=0.2)
    late = round((RESTORE_AFTER_S + 2 * HOP_PERIOD_S) / CHUNK_S)
    assert set(hops[: round((RESTORE_AFTER_S - HOP_PERIOD_S) / CHUNK_S)]) == {4}
    assert set(hops[late:]) == {1}


def test_a_load_between_the_limits_does_not_change_the_hop() -> None:
    recognizer = Recognizer()
    recognizer.run(5.0, others=0.25, network=0.8)
    assert set(recognizer.run(20.0, others=0.25, network=0.29)) == {3, 2}
    assert set(recognizer.run(20.0, others=0.25, network=0.29)) == {2}


def test_the_hop_falls_only_as_far_as_the_highest_recent_load_allows() -> None:
    recognizer = Recognizer()
    recognizer.run(5.0, others=0.3, network=1.1)
    hops = []
    for _ in range(10):
        hops += recognizer.run(1.0, others=0.3, network=0.1)
        hops += recognizer.run(1.0, others=0.3, network=0.35)
    assert set(hops[-100:]) == {2}


def test_the_network_runs_less_often_while_a_session_is_behind() -> None:
    recognizer = Recognizer()
    hops = recognizer.run(5.0, others=0.1, network=0.1, is_behind=True)
    assert hops[0] == 1
    assert hops[-1] == MAX_HOP_BLOCKS
    assert recognizer.run(2 * RESTORE_AFTER_S, others=0.1, network=0.1)[-1] == 1
