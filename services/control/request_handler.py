"""Handles requests: checks roles, and repeats the answer to a repeated request."""

from collections import OrderedDict
from collections.abc import Callable
from typing import Any, TypeAlias

from kouxing_client.messages import Message

from kouxing.shared.errors import Rejected
from kouxing.shared.monitoring.metrics import Metrics
from kouxing.shared.network.bus import Bus
from kouxing.shared.network.peer import Peer
from kouxing.shared.network.sockets import Socket
from kouxing.shared.service.message_loop import Handler
from kouxing.shared.settings.keys import Grant
from kouxing.shared.wire.face import SetFace
from kouxing.shared.wire.session import (
    CloseSession,
    Error,
    ErrorCode,
    FlushSession,
    OpenSession,
    StatusReport,
    StatusRequest,
)

MAX_ANSWERS = 1000  # number of answers that are kept for repeated requests
MAX_DEFERRED = 1000
TEMPORARY_ERRORS = (ErrorCode.UNKNOWN_SESSION, ErrorCode.NO_SERVICE)  # may be temporary
Request: TypeAlias = OpenSession | CloseSession | FlushSession | SetFace | StatusRequest


class RequestHandler:
    """Handles requests on control's socket.

    While ``may_defer`` returns True, requests that fail with a temporary error wait for
    ``retry_deferred``.
    """

    def __init__(
        self, bus: Bus, commands: Socket, metrics: Metrics, may_defer: Callable[[], bool]
    ) -> None:
        self._bus = bus
        self._commands = commands
        self._metrics = metrics
        self._may_defer = may_defer
        self._answers: OrderedDict[tuple[Peer, int, str], Message] = OrderedDict()
        self._deferred: list[tuple[Handler, Request, Peer]] = []

    def make_handler(self, handle: Callable[[Any, Peer], Message | None], *roles: str) -> Handler:
        """Return a handler that answers a request with the result of ``handle``.

        If roles are given, the sender's key must have one of them.
        """

        def on_request(message: Request, sender: Peer) -> None:
            if message.request is not None:
                answer = self._answers.get((sender, sender.connection, message.request))
                if answer is not None:
                    self._commands.send(answer, to=sender)
                    return
            try:
                self.check_role(sender, *roles)
                answer = handle(message, sender)
            except Rejected as rejection:
                if self._can_defer(rejection):
                    self._deferred.append((on_request, message, sender))
                    return
                self._metrics.count(f"refused_{rejection.code}")
                answer = Error(
                    session=message.session,
                    code=rejection.code,
                    text=rejection.text,
                    request=message.request,
                    retry_after_s=rejection.retry_after_s,
                )
            if answer is not None:
                self.answer(sender, message.request, answer)

        return on_request

    def answer(self, sender: Peer, request: str | None, answer: Message) -> None:
        """Send an answer, and keep it in case the request is repeated."""
        if request is not None and not isinstance(answer, StatusReport):
            self._answers[sender, sender.connection, request] = answer
            if len(self._answers) > MAX_ANSWERS:
                self._answers.popitem(last=False)
        self._commands.send(answer, to=sender)

    def check_role(self, sender: Peer, *roles: str) -> None:
        """Reject a sender unless its key has one of ``roles``; accept anyone if ``insecure``.

        Raises ``Rejected`` if the key lacks these roles.
        """
        if roles and not self.has_role(sender.key, *roles):
            grant = self._find_grant(sender.key)
            name = grant.name if grant else "(revoked)"
            text = (
                f"the key {name} has no role {' or '.join(roles)}; on"
                " control's machine, 'kouxing keys list' shows the roles, and 'kouxing keys add'"
                " creates another key"
            )
            raise Rejected(ErrorCode.NOT_ALLOWED, text)

    def has_role(self, key: str, *roles: str) -> bool:
        """Return whether a key has one of ``roles``; True if ``insecure``."""
        if self._bus.zap is None:
            return True
        grant = self._find_grant(key)
        return grant is not None and not set(roles).isdisjoint(grant.roles)

    def _find_grant(self, key: str) -> Grant | None:
        return None if self._bus.zap is None else self._bus.zap.grants.get(key)

    def may_see_token(self, sender: Peer) -> bool:
        """Return whether a sender may have the page's token: a client or a service."""
        zap, key = self._bus.zap, sender.key
        return zap is None or self.has_role(key, "client") or zap.is_service(key)

    def retry_deferred(self) -> None:
        """Handle the deferred requests again."""
        deferred, self._deferred = self._deferred, []
        for handle, message, sender in deferred:
            handle(message, sender)

    def _can_defer(self, rejection: Rejected) -> bool:
        return (
            self._may_defer()
            and rejection.code in TEMPORARY_ERRORS
            and len(self._deferred) < MAX_DEFERRED
        )
