"""HTTP API that starts and stops senders to programs that show the face.

A page can start senders only to programs on the gateway's machine and to addresses in the
configuration. It cannot make the gateway send to arbitrary hosts.
"""

import json
from collections.abc import Callable, Iterable
from dataclasses import asdict

import numpy as np
from aiohttp import web

from kouxing.services.gateway.messages import browser_messages
from kouxing.services.senders.protocols import parse_target
from kouxing.services.senders.sender_pool import SenderPool
from kouxing.services.senders.target import Target, parse_delay_s
from kouxing.shared.clock import to_seconds
from kouxing.shared.errors import UserError
from kouxing.shared.monitoring.logs import LOG
from kouxing.shared.settings.endpoints import is_loopback


class SendersApi:
    """Sends the gateway's face to other programs with a ``pool``, and reports their state.

    ``on_started`` is called when a page starts a sender.
    """

    def __init__(
        self, urls: Iterable[str], on_started: Callable[[], None], *, idle_motion: bool
    ) -> None:
        self._configured = {target.url: target for target in map(parse_target, urls)}
        self._on_started = on_started
        self.pool = SenderPool(_log_problem, idle_motion=idle_motion)
        for target in self._configured.values():
            self.pool.start(target)

    def send_frame(self, media_time: int, values: bytes) -> None:
        """Send a frame: 68 little-endian float32, FAP units."""
        faps = np.frombuffer(values, "<f4").astype(np.float32)
        self.pool.show(to_seconds(media_time), faps)

    async def serve_get(self, _request: web.Request) -> web.StreamResponse:
        """Answer with the state of all senders."""
        return self._state()

    async def serve_post(self, request: web.Request) -> web.StreamResponse:
        """Start or stop a sender, or delay all; answer with their state or with an error."""
        try:
            command = browser_messages.parse_object(await request.read())
            match [*command.items()]:
                case [("start", str(url))]:
                    self.pool.start(self._allowed_target(url))
                    self._on_started()
                case [("stop", str(url))]:
                    self.pool.stop(parse_target(url))
                case [("delay_ms", int() | float() as delay_ms)] if not isinstance(delay_ms, bool):
                    self.pool.set_delay(parse_delay_s(delay_ms))
                case _:
                    raise UserError(
                        "expected 'start' or 'stop' with an address such as vmc://, or "
                        "'delay_ms' with a number, and no other field"
                    )
        except UserError as error:
            return web.json_response({"error": str(error)}, status=422)
        return self._state()

    def _allowed_target(self, url: str) -> Target:
        target = parse_target(url)
        if target.is_local or target.url in self._configured:
            return target
        if not is_loopback(target.host):
            raise UserError(
                f"{target.host} is another machine; add the address to gateway.senders, "
                "or use 'kouxing send'"
            )
        raise UserError(
            f"camera={target.options['camera']} accepts data from other machines; "
            "write only its port, add the address to gateway.senders, or use 'kouxing send'"
        )

    def _state(self) -> web.Response:
        states = self.pool.states()
        running = {parse_target(state.target).key for state in states}
        return web.json_response(
            {
                "senders": [asdict(state) for state in states],
                "stopped": [
                    url for url, target in self._configured.items() if target.key not in running
                ],
            },
            dumps=lambda answer: json.dumps(answer, ensure_ascii=False),
        )


def _log_problem(url: str, problem: str) -> None:
    if problem:
        LOG.warning("%s: %s", url, problem)
    else:
        LOG.info("%s: sending frames again", url)
