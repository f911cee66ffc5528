"""Other programs that show the face: those of the configuration, and those the page asks for.

No page may make the gateway send to whatever it likes: beside what the configuration names only
programs on the gateway's own machine are sent to.
"""

from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np
from aiohttp import web

from kouxing.services.gateway import wire
from kouxing.services.senders.senders import Senders
from kouxing.services.senders.target import Target, parse_delay_s, parse_target
from kouxing.shared.clock import to_seconds
from kouxing.shared.errors import UserError
from kouxing.shared.logs import LOG


class Sending:
    """Sends the face that the gateway shows, and tells the page about it.

    Parameters
    ----------
    urls
        Of ``gateway.senders``.
    idle_motion_seed
        Of the face while nobody speaks.
    """

    def __init__(self, urls: str, idle_motion_seed: int) -> None:
        self._configured = {url: parse_target(url) for url in urls.split()}
        self._senders = Senders(idle_motion_seed, _report)
        for target in self._configured.values():
            self._senders.start(target)

    def accept(self, media_time: int, values: bytes) -> None:
        """Show a frame of the session that is shown now: 68 float32, FAP units."""
        faps = np.frombuffer(values, "<f4").astype(np.float32)
        self._senders.accept(to_seconds(media_time), faps)

    def close(self) -> None:
        """Stop all."""
        self._senders.close()

    async def show(self, _request: web.Request) -> web.StreamResponse:
        """Answer what is sent to whom."""
        return self._answer()

    async def change(self, request: web.Request) -> web.StreamResponse:
        """Start or stop a sender, or delay all; answer as ``show`` does, or what is wrong."""
        try:
            command = wire.parse_object(await request.text())
            start, stop, delay_ms = (command.get(key) for key in ("start", "stop", "delay_ms"))
            if isinstance(start, str):
                self._senders.start(self._allowed(start))
            elif isinstance(stop, str):
                self._senders.stop(stop)
            elif isinstance(delay_ms, int | float):
                self._senders.delay(parse_delay_s(delay_ms))
            else:
                raise UserError("expected 'start' or 'stop' with an address such as vmc://")
        except UserError as error:
            return web.json_response({"error": str(error)}, status=422)
        return self._answer()

    def _allowed(self, url: str) -> Target:
        target = parse_target(url)
        if not (target.is_local or url in self._configured):
            raise UserError(
                f"{target.host} is another machine: name the address in gateway.senders, "
                "or use 'kouxing send'"
            )
        return target

    def _answer(self) -> web.Response:
        states = self._senders.states()
        running = {state.target for state in states}
        return web.json_response(
            {
                "senders": [asdict(state) for state in states],
                "stopped": [url for url in self._configured if url not in running],
            },
            dumps=lambda answer: json.dumps(answer, ensure_ascii=False),
        )


def _report(url: str, problem: str) -> None:
    if problem:
        LOG.warning("%s: %s", url, problem)
    else:
        LOG.info("%s: frames leave again", url)
