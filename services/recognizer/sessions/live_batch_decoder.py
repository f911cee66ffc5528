"""Decodes the live audio of all sessions in batches; the block network runs on a thread."""

import time
from collections.abc import Callable, Sequence, Sized

from kouxing.services.recognizer.acoustic.blocks import BlockRunner
from kouxing.services.recognizer.live.recognizer import Recognizer
from kouxing.services.recognizer.sessions.hop_controller import (
    MAX_HOP_BLOCKS,
    HopController,
    ProcessorTime,
)
from kouxing.services.recognizer.sessions.network_thread import NetworkThread
from kouxing.services.recognizer.sessions.session import RecognizerSession
from kouxing.shared.monitoring.metrics import LoadMeter

MAX_BATCH_S = 0.3  # audio of all sessions that is decoded together
MIN_PART_S, MAX_PART_S = 0.02, 0.06  # audio of each live session in such a batch
SESSIONS_PER_RUN = 4  # the encoder processes these in one run
NETWORK_WEIGHT = 0.25  # weight of the block network's time in the load of the service


class LiveBatchDecoder:
    """Decodes live audio in batches. The load determines the hop of the block network.

    ``sessions`` are all sessions of the service. In ``load_meter``, the network's time counts less.
    The network's thread calls ``wake`` when sessions are decoded. ``on_early`` gets a session whose
    lips are ready before its phones, and ``on_decoded`` the decoded sessions. ``on_batch`` is
    called after each batch.
    """

    def __init__(
        self,
        sessions: Sized,
        recognizer: Recognizer,
        load_meter: LoadMeter,
        wake: Callable[[], None],
        on_early: Callable[[RecognizerSession], None],
        on_decoded: Callable[[Sequence[RecognizerSession]], None],
        on_batch: Callable[[], None],
    ) -> None:
        self._all_sessions = sessions
        self._recognizer = recognizer
        self._load_meter = load_meter
        self._on_early, self._on_decoded, self._on_batch = on_early, on_decoded, on_batch
        self._network = NetworkThread(recognizer, wake)
        self.unpaced_work = ProcessorTime()  # part of ``work`` that is not for live audio
        self._hop_controller = HopController(self.work, time.monotonic())

    @property
    def hop(self) -> int:
        """The current hop of the block network, in blocks."""
        return self._hop_controller.hop

    @property
    def work(self) -> ProcessorTime:
        """The work of the service so far."""
        network_s = BlockRunner.total_run_s
        return ProcessorTime(network_s, time.thread_time() + self._network.work_s - network_s)

    def decode_all(self, sessions: Sequence[RecognizerSession]) -> None:
        """Decode all queued audio of sessions."""
        while any(session.is_decoding for session in sessions):
            self._network.start(time.monotonic())
            self._network.wait()
            self.decode(sessions)

    def decode(self, sessions: Sequence[RecognizerSession]) -> None:
        """Decode a part of the queued audio of sessions; skip audio that is too old.

        The network's thread decodes sessions that need the block network. Under load, their lips
        are sent before it finishes. Otherwise, their later audio waits in the queue.
        """
        # Under load, the network runs at the longest hop, and on another core.
        network_weight = NETWORK_WEIGHT * self._hop_controller.hop / MAX_HOP_BLOCKS
        if decoded := self._network.take_decoded():
            self._load_meter.add(network_weight * self._network.batch_s)
            # speech that the encoder found during the run; sessions with more audio follow below
            ended = [session for session in decoded if not session.audio]
            ready = [session for session in ended if not self._queue_for_network(session)]
            self._recognizer.decode_speech([session.stream for session in ready])
            self._on_decoded(decoded)
        sessions = [session for session in sessions if session.can_accept]
        now_s = time.monotonic()
        if sessions:
            is_behind = any(session.audio.skip_policy.is_behind for session in sessions)
            self._hop_controller.update(self.work - self.unpaced_work, now_s, is_behind=is_behind)
        part_s = min(MAX_PART_S, max(MIN_PART_S, MAX_BATCH_S / max(1, len(sessions))))
        # in groups, so that the first sessions do not wait for all others
        for begin in range(0, len(sessions), SESSIONS_PER_RUN):
            group = sessions[begin : begin + SESSIONS_PER_RUN]
            for session in group:
                session.accept_waveform(part_s, now_s, self._hop_controller.hop)
            self._recognizer.detect_speech([session.stream for session in group])
            if len(self._all_sessions) <= 1 and not group[0].is_scoring:  # no other session waits
                network_s = BlockRunner.total_run_s
                self._decode(group)
                self._load_meter.add((network_weight - 1.0) * (BlockRunner.total_run_s - network_s))
            else:
                self._decode([session for session in group if not self._queue_for_network(session)])
        self._network.start(now_s, may_wait=self._hop_controller.hop > 1)
        self._on_batch()

    def _decode(self, sessions: Sequence[RecognizerSession]) -> None:
        self._recognizer.decode_speech([session.stream for session in sessions])
        self._on_decoded(sessions)

    def _queue_for_network(self, session: RecognizerSession) -> bool:
        """Queue a session that needs the block network; under load, send its lips first.

        Returns whether the session was queued.
        """
        if not (session.is_scoring or session.stream.needs_network):
            return False
        if session.is_scoring or self._hop_controller.hop > 1:
            session.stream.decode_early()
            self._on_early(session)
        if not session.is_scoring:
            self._network.add(session, time.monotonic())
        return True
