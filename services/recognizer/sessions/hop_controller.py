"""Runs the block network less often while a recognizer is overloaded.

All sessions have the same *hop*, the number of blocks between two runs of the network. A longer hop
saves time, but phones are emitted and corrected later. :mod:`kouxing.shared.service.overload`
describes the later stages of the degradation, which affect single sessions.
"""

from __future__ import annotations

from dataclasses import dataclass

MAX_HOP_BLOCKS = 6  # 240 ms
MAX_LOAD_CORES = 0.6  # of a recognizer; above it, the network runs less often
RESTORE_LOAD_CORES = 0.5  # expected load at which the network runs more often again
RESTORE_AFTER_S = 5.0  # time for which the expected load must be below ``RESTORE_LOAD_CORES``
HOP_PERIOD_S = 0.5  # the load is measured over this time


@dataclass(frozen=True, slots=True)
class ProcessorTime:
    """Processor time spent on sessions, in seconds."""

    network_s: float = 0.0  # in the block network
    other_s: float = 0.0  # in the rest of the recognizer

    def __add__(self, other: ProcessorTime) -> ProcessorTime:
        return ProcessorTime(self.network_s + other.network_s, self.other_s + other.other_s)

    def __sub__(self, other: ProcessorTime) -> ProcessorTime:
        return ProcessorTime(self.network_s - other.network_s, self.other_s - other.other_s)


class HopController:
    """Chooses the hop of the block network from the load of a recognizer.

    The processor time of the network is proportional to 1 / hop, so the controller chooses the
    shortest hop whose expected load is low enough. While a session is behind, it also increases the
    hop, because other programs may be using the processor. It increases the hop after one period,
    but decreases it only after several.

    ``work`` is the processor time spent before the controller was created; it is ignored. Times are
    in seconds, on any monotonic clock.
    """

    def __init__(self, work: ProcessorTime, now_s: float) -> None:
        self.hop = 1  # blocks
        self._since_s = self._restored_s = now_s
        self._before = work
        self._needed = 1  # the longest hop needed since ``_restored_s``
        self._is_behind = False  # whether a session has been behind since ``_since_s``

    def update(self, work: ProcessorTime, now_s: float, *, is_behind: bool) -> int:
        """Return the hop for the total work on live sessions so far.

        Set ``is_behind`` if a session's results are late.
        """
        self._is_behind |= is_behind
        passed_s = now_s - self._since_s
        if passed_s < HOP_PERIOD_S:
            return self.hop
        newest = work - self._before
        self._since_s, self._before = now_s, work
        network, others = self.hop * newest.network_s / passed_s, newest.other_s / passed_s
        hop = min(self.hop + self._is_behind, MAX_HOP_BLOCKS)
        self.hop = max(hop, _shortest_hop(network, others, MAX_LOAD_CORES))
        needed = self.hop if self._is_behind else _shortest_hop(network, others, RESTORE_LOAD_CORES)
        self._is_behind = False
        self._needed = max(self._needed, needed)
        if needed >= self.hop:
            self._restored_s, self._needed = now_s, 1
        elif now_s - self._restored_s >= RESTORE_AFTER_S:
            self.hop, self._restored_s, self._needed = self._needed, now_s, 1
        return self.hop


def _shortest_hop(network: float, others: float, max_load: float) -> int:
    """Return the shortest hop whose load is at most ``max_load``.

    ``network`` is the load of the network at hop 1; ``others`` is the rest.
    """
    hops = range(1, MAX_HOP_BLOCKS)
    return next((hop for hop in hops if network / hop + others <= max_load), MAX_HOP_BLOCKS)
