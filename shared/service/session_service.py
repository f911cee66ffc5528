"""Base of the services with sessions, which control starts and stops."""

import time
from collections.abc import Iterable

from kouxing_client.field_types import MAX_TEXT
from kouxing_client.messages import Event, Message

from kouxing.shared.errors import Rejected, StartFailure, UserError
from kouxing.shared.files.output_file import path_as_text
from kouxing.shared.monitoring.logs import LOG
from kouxing.shared.network.peer import Peer
from kouxing.shared.service.base import HEARTBEAT_S, Service
from kouxing.shared.service.message_loop import Handler
from kouxing.shared.wire.control import EventName, SessionStarted, StartSession
from kouxing.shared.wire.face import SetFace
from kouxing.shared.wire.session import CloseSession, Error, ErrorCode, FlushSession


class SessionService(Service):
    """Base class of services with sessions. A subclass overrides the first methods below."""

    def start_session(self, start: StartSession) -> bool:
        """Serve a session. Return False if ``session_started`` is called later.

        Raises ``Rejected`` if this service may not serve the session, or ``UserError`` if it cannot
        because of a fault. Control then rejects the session, with the code of a ``StartFailure`` or
        with ``no-service``.
        """
        return True

    def stop_session(self, session: str) -> None:
        """Stop serving a session, if it exists."""

    def flush_session(self, message: FlushSession) -> None:
        """Drop audio of a session whose face is not shown yet."""

    def change_face(self, message: SetFace) -> None:
        """Change the face of a session, or the face at rest if the message has no session."""

    def served_sessions(self) -> Iterable[StartSession]:
        """Return the sessions that a restarted control restores from this service."""
        return ()

    def control_handlers(self) -> dict[type[Message], Handler]:
        """Return the handlers of control's messages; subclasses add theirs."""
        return {
            **super().control_handlers(),
            StartSession: self._on_start_session,
            CloseSession: lambda message, _: self.stop_session(message.session),
            FlushSession: lambda message, _: self.flush_session(message),
            SetFace: lambda message, _: self.change_face(message),
        }

    def on_control_restart(self) -> None:
        """Report the sessions, so that control restores them."""
        for start in self.served_sessions():
            self.send_to_control(
                SessionStarted(session=start.session, request=start.request, start=start)
            )

    def session_started(self, start: StartSession, final_until: int = 0) -> None:
        """Report that this service serves a session, whose phones are final up to a media time."""
        self.send_to_control(
            SessionStarted(session=start.session, request=start.request, final_until=final_until)
        )

    def publish_event(
        self, name: EventName, start: StartSession, detail: str = "", media_time: int = 0
    ) -> None:
        """Ask control to publish an event about a session."""
        event = Event(
            session=start.session,
            session_id=start.session_id,
            name=name,
            detail=path_as_text(detail)[:MAX_TEXT],
            media_time=media_time,
        )
        self.send_to_control(event)

    def report_skipped(self, start: StartSession, skipped_s: float) -> None:
        """Count and publish the duration of a live session's skipped audio, unless it is 0."""
        if skipped_s > 0.0:
            self.metrics.count("skipped_audio_ms", round(1e3 * skipped_s))
            self.publish_event(EventName.AUDIO_SKIPPED, start, f"{skipped_s:.2f} s")

    def _on_start_session(self, start: StartSession, _sender: Peer) -> None:
        if self.should_exit:
            return
        try:
            heartbeat_due_s = time.monotonic() + HEARTBEAT_S
            self._heartbeat_due_s = min(self._heartbeat_due_s, heartbeat_due_s)
            if self.start_session(start):
                self.session_started(start)
        except Rejected as rejection:
            LOG.info(rejection.text, extra={"session": start.session})
            self._reject(start, rejection)
        except UserError as error:
            code = error.code if isinstance(error, StartFailure) else ErrorCode.NO_SERVICE
            self.warn("start", str(error), start.session)
            self.publish_event(EventName.ERROR, start, f"{code}: {error}")
            self._reject(start, Rejected(code, str(error)))

    def _reject(self, start: StartSession, rejection: Rejected) -> None:
        self.send_to_control(
            Error(
                session=start.session,
                request=start.request,
                code=rejection.code,
                text=path_as_text(rejection.text),
                retry_after_s=rejection.retry_after_s,
            )
        )
