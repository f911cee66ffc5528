"""Decodes the audio of sessions that are not paced, when no live audio waits."""

import time
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter

from kouxing.services.recognizer.live.recognizer import Recognizer
from kouxing.services.recognizer.sessions.live_batch_decoder import MAX_BATCH_S, LiveBatchDecoder
from kouxing.services.recognizer.sessions.session import RecognizerSession
from kouxing.shared.network.sockets import Socket
from kouxing.shared.service.message_loop import MessageLoop

MAX_UNPACED_S = 0.06  # limit for unpaced audio decoded at a time, while live sessions are open


class UnpacedDecoder:
    """Decodes some unpaced audio at a time. Further audio waits in the socket, then at the sender.

    ``sessions`` are all sessions of the service. ``loop`` reads ``socket``, which receives the
    audio. ``on_decoded`` gets the decoded sessions. The work is counted in ``live``.
    """

    def __init__(
        self,
        sessions: Mapping[str, RecognizerSession],
        recognizer: Recognizer,
        loop: MessageLoop,
        socket: Socket,
        live: LiveBatchDecoder,
        on_decoded: Callable[[Sequence[RecognizerSession]], None],
    ) -> None:
        self.is_blocked = False  # by a synthesizer's backlog
        self.last_read_s = time.monotonic()  # when unpaced audio was last read
        self._all_sessions = sessions
        self._recognizer = recognizer
        self._loop = loop
        self._socket = socket
        self._live = live
        self._on_decoded = on_decoded

    @property
    def has_audio(self) -> bool:
        """Whether queued audio is not decoded yet."""
        return any(session.audio for session in self._sessions)

    @property
    def can_decode(self) -> bool:
        """Whether queued audio may be decoded now."""
        return self.has_audio and not self.is_blocked

    @property
    def queued_s(self) -> float:
        """Duration of the audio that is not decoded yet."""
        return sum(session.audio.duration_s for session in self._sessions)

    def limit_reading(self) -> None:
        """Stop reading audio while enough of it is queued."""
        is_full = self.queued_s >= self._max_s
        is_paused = is_full or self.is_blocked
        self._loop.pause(self._socket, paused=is_paused)
        if not is_paused:
            self.last_read_s = time.monotonic()

    def decode(self) -> None:
        """Decode some audio."""
        before = self._live.work
        left_s = self._max_s
        batch = []
        # the session that has waited longest is first, so that no session starves
        for session in sorted(self._sessions, key=attrgetter("accepted_s")):
            if session.audio and left_s > 0.0:
                queued_s = session.audio.duration_s
                session.accept_waveform(left_s, time.monotonic(), hop=1)
                left_s -= queued_s - session.audio.duration_s
                batch.append(session)
        self._recognizer.decode_streams([session.stream for session in batch])
        self._on_decoded(batch)
        self.limit_reading()
        self._live.unpaced_work += self._live.work - before

    @property
    def _sessions(self) -> list[RecognizerSession]:
        return [session for session in self._all_sessions.values() if not session.is_paced]

    @property
    def _max_s(self) -> float:
        """Duration of audio that is decoded, and read, at a time."""
        has_live_sessions = len(self._sessions) < len(self._all_sessions)
        return MAX_UNPACED_S if has_live_sessions else MAX_BATCH_S
