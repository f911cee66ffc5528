"""Checks clients' audio messages and reports rejected ones."""

import logging
import time

from kouxing.services.recognizer.sessions.session import RecognizerSession
from kouxing.shared.errors import Rejected
from kouxing.shared.network.peer import Peer
from kouxing.shared.network.sockets import Socket
from kouxing.shared.service.message_loop import MessageLoop
from kouxing.shared.wire.session import AudioChunk, Error, ErrorCode


class AudioIntake:
    """Accepts the audio of sessions. The loop counts and logs problems."""

    def __init__(self, loop: MessageLoop) -> None:
        self._loop = loop

    def receive(
        self, session: RecognizerSession | None, socket: Socket, message: AudioChunk, sender: Peer
    ) -> None:
        """Queue the audio of a client's message. Without an open session, reject the message."""
        try:
            if session is None:
                text = f"session {message.session!r} is not open here; open it at control"
                raise Rejected(ErrorCode.UNKNOWN_SESSION, text)
            session.check_sender(message, socket)
            if 0 < message.epoch < session.first_epoch:  # sent to the recognizer before this one
                self._loop.metrics.count("other_epoch")
                return
            self._receive_from_client(session, message, sender)
        except Rejected as rejection:
            self._reject(socket, message, sender, rejection)

    def _receive_from_client(
        self, session: RecognizerSession, message: AudioChunk, sender: Peer
    ) -> None:
        """Queue the audio of the next message; a rejected message also counts as received."""
        now_s = time.monotonic()
        session.client = sender
        is_next = False
        if message.sequence <= session.last_sequence:
            self._loop.metrics.count("repeated")
        else:
            session.on_new_audio(now_s)
            is_next = session.accept_in_order(message, now_s)
        if message.acknowledge:  # immediately if the client resends or must fill a gap
            at_once = not is_next or session.is_finished
            session.request_acknowledgement(now_s, at_once=at_once)
        if not is_next:
            return
        session.check_open(message)
        if message.last:
            session.last_chunk = message
        is_flushed = message.sequence <= session.flushed_sequence
        if is_flushed or (message.last and not message.pcm):
            return
        if error := session.mouth_profile_error:
            session.mouth_profile_error = ""
            rejection = Rejected(ErrorCode.BAD_MOUTH_PROFILE, error)
            self._reject(session.socket, message, sender, rejection)
        chunk = session.read_chunk(message, now_s)
        if chunk is not None:
            session.audio.append(chunk, now_s)

    def _reject(
        self, socket: Socket, message: AudioChunk, sender: Peer, rejection: Rejected
    ) -> None:
        is_expected = rejection.code == ErrorCode.UNKNOWN_SESSION  # after Ctrl-C in a client
        level = logging.INFO if is_expected else logging.WARNING
        self._loop.warn(rejection.code, rejection.text, message.session, level)
        error = Error(
            session=message.session,
            media_time=message.media_time,
            code=rejection.code,
            text=rejection.text,
        )
        socket.send(error, to=sender)
