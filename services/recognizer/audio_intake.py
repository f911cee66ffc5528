"""Checks clients' audio messages and reports rejected ones."""

import logging
import time
from collections.abc import Callable

from kouxing.services.recognizer.resumption import Chunk
from kouxing.services.recognizer.session import AudioRejected, RecognizerSession
from kouxing.shared.keys import Peer
from kouxing.shared.message_loop import MessageLoop
from kouxing.shared.sockets import Socket
from kouxing.shared.wire.audio import AudioChunk
from kouxing.shared.wire.session import Error, ErrorCode


class AudioIntake:
    """Accepts the audio of sessions.

    Parameters
    ----------
    loop
        Counts and logs problems.
    on_chunk
        Called with each chunk of valid audio.
    on_end
        Called when the last chunk of a session has arrived.
    """

    def __init__(
        self,
        loop: MessageLoop,
        on_chunk: Callable[[RecognizerSession, Chunk], None],
        on_end: Callable[[RecognizerSession], None],
    ) -> None:
        self._loop = loop
        self._on_chunk, self._on_end = on_chunk, on_end

    def receive(
        self, session: RecognizerSession | None, socket: Socket, message: AudioChunk, sender: Peer
    ) -> None:
        """Process a client's message. Without an open session, reject it."""
        try:
            if session is None:
                text = f"session {message.session!r} is not open here; open it at control"
                raise AudioRejected(ErrorCode.UNKNOWN_SESSION, text)
            session.check_sender(message, socket)
        except AudioRejected as rejection:
            self._reject(socket, message, sender, rejection)
            return
        if 0 < message.epoch < session.first_epoch:  # sent to the recognizer before this one
            self._loop.metrics.count("other_epoch")
            return
        now_s = time.monotonic()
        session.client = sender
        is_next = False
        if message.sequence <= session.last_sequence:
            self._loop.metrics.count("repeated")
        else:
            session.on_new_audio(now_s)
            is_next = session.accept_in_order(message, now_s)
        if is_next:
            self._accept(session, message, sender)
        if message.acknowledge:  # immediately if the client resends or must fill a gap
            at_once = not is_next or session.is_finished
            session.request_acknowledgement(now_s, at_once=at_once)

    def _accept(self, session: RecognizerSession, message: AudioChunk, sender: Peer) -> None:
        """Accept the next message; a rejected one counts as received."""
        try:
            session.check_open(message)
        except AudioRejected as rejection:
            self._reject(session.socket, message, sender, rejection)
            return
        if message.pcm or not message.last:
            self._accept_chunk(session, message, sender)
        if message.last:
            session.end = message
            self._on_end(session)

    def _accept_chunk(self, session: RecognizerSession, message: AudioChunk, sender: Peer) -> None:
        if error := session.mouth_profile_error:
            session.mouth_profile_error = ""
            rejection = AudioRejected(ErrorCode.BAD_MOUTH_PROFILE, error)
            self._reject(session.socket, message, sender, rejection)
        try:
            chunk = session.read_chunk(message, time.monotonic())
        except AudioRejected as rejection:
            self._reject(session.socket, message, sender, rejection)
            return
        if chunk is not None:
            self._on_chunk(session, chunk)

    def _reject(
        self, socket: Socket, message: AudioChunk, sender: Peer, rejection: AudioRejected
    ) -> None:
        text = str(rejection)
        is_expected = rejection.code == ErrorCode.UNKNOWN_SESSION  # after Ctrl-C in a client
        level = logging.INFO if is_expected else logging.WARNING
        self._loop.warn(rejection.code, text, message.session, level)
        error = Error(
            session=message.session, media_time=message.media_time, code=rejection.code, text=text
        )
        socket.send(error, to=sender)
