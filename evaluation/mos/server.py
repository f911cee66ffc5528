"""The page that judges see: which video comes next, and their scores.

==========================  ==============================================================
request                     answer
==========================  ==============================================================
``GET /``, ``GET /NAME``    the page and its files
``GET /study``              its title, the page's languages and the number of videos that count
``POST /judges``            ``{"judge": token}``: a new judge
``GET /state``              ``{"hears": bool, "place": n}``: whether the sound check is passed, and
                            which place is next (below 0: practice; null: none)
``GET /beeps``              WAV file of the sound check
``POST /beeps``             ``{"beeps": n}``, how many were heard: the state
``GET /stimulus/PLACE``     the judge's video at this place, if it is the next
``POST /answers``           ``{"place": n, "sync": 1..5, "realism": 1..5, "language": "zh"|"en"}``:
                            the state
==========================  ==============================================================

Those below ``/judges`` take ``?judge=TOKEN``; all but the page's files must meet the gateway's
``AccessPolicy``. No request names a file or a condition: a judge's places do. A video that was not
fetched has no answer (409).
"""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from aiohttp import web

from kouxing.evaluation.mos.beeps import make_beeps
from kouxing.evaluation.mos.order import places_of_judge
from kouxing.evaluation.mos.store import Answer, Judge, Store
from kouxing.evaluation.mos.study import LANGUAGES, SCALES, Study
from kouxing.services.gateway import http
from kouxing.services.gateway.access import AccessPolicy
from kouxing.services.gateway.config import GatewayConfig
from kouxing.services.gateway.page_endpoint import make_page_endpoint
from kouxing.services.gateway.web_server import WebServer, bind_port
from kouxing.shared.logs import LOG

PAGE = Path(__file__).parent / "page"
FILES = {
    **{path.name: path for path in PAGE.iterdir() if path.suffix in {".html", ".js", ".css"}},
    "language.js": http.PAGE / "language.js",
    "icon.svg": http.PAGE / "icon.svg",
}
MAX_BODY_BYTES = 1024
_POLICY = "default-src 'self'; object-src 'none'; base-uri 'none'; frame-ancestors 'none'"


class ListeningTest:
    """Answers requests of judges."""

    def __init__(self, study: Study, store: Store) -> None:
        self._study = study
        self._store = store

    def make_application(self, access: AccessPolicy) -> web.Application:
        """Return the web application."""
        routes = [
            web.get("/study", self._show_study),
            web.post("/judges", self._add_judge),
            web.get("/state", self._show_state),
            web.get("/beeps", self._play_beeps),
            web.post("/beeps", self._check_sound),
            web.get("/stimulus/{place}", self._play_stimulus),
            web.post("/answers", self._add_answer),
        ]
        application = web.Application(
            middlewares=[access.middleware({route.path for route in routes})],
            client_max_size=MAX_BODY_BYTES,
        )
        application.on_response_prepare.append(http.add_headers)
        application.add_routes(routes)
        application.router.add_get("/", _serve_page)
        application.router.add_get("/{name}", _serve_page)
        return application

    async def _show_study(self, _request: web.Request) -> web.Response:
        return web.json_response(
            {
                "title": self._study.title,
                "languages": self._study.languages,
                "videos": len(self._study.files),
            }
        )

    async def _add_judge(self, _request: web.Request) -> web.Response:
        token = self._store.add_judge()
        if token is None:
            raise web.HTTPServiceUnavailable(text="there are too many judges\n")
        return web.json_response({"judge": token})

    async def _show_state(self, request: web.Request) -> web.Response:
        return self._state(self._judge(request))

    async def _play_beeps(self, request: web.Request) -> web.Response:
        sound = make_beeps(self._judge(request).beeps)
        return web.Response(body=sound, content_type="audio/wav")

    async def _check_sound(self, request: web.Request) -> web.Response:
        fields = await _read(request, "beeps")
        self._store.check_sound(self._judge(request), fields["beeps"])
        return self._state(self._judge(request))

    async def _play_stimulus(self, request: web.Request) -> web.StreamResponse:
        judge = self._judge(request)
        place = self._next_place(judge)
        if place is None or request.match_info["place"] != str(place):
            raise web.HTTPNotFound
        self._store.note_fetched(judge, place)
        return web.FileResponse(self._study.files[self._places(judge)[place]])

    async def _add_answer(self, request: web.Request) -> web.Response:
        fields = await _read(request, "place", *SCALES)
        place, language = fields["place"], fields.get("language")
        judge = self._judge(request)
        cell = self._places(judge).get(place)
        if cell is None or judge.number is None or judge.fetched is None or place > judge.fetched:
            raise web.HTTPConflict(text="this video was not fetched\n")
        if not all(1 <= fields[scale] <= 5 for scale in SCALES):
            raise web.HTTPBadRequest(text="scores are 1 to 5\n")
        if language not in LANGUAGES:
            raise web.HTTPBadRequest(text=f"language is {' or '.join(LANGUAGES)}\n")
        now_s = time.time()
        self._store.add(
            Answer(judge.number, place, *cell, scale, fields[scale], language, now_s)
            for scale in SCALES
        )
        return self._state(judge)

    def _judge(self, request: web.Request) -> Judge:
        judge = self._store.find_judge(request.query.get("judge", ""))
        if judge is None:
            raise web.HTTPNotFound(text="there is no such judge\n")
        return judge

    def _places(self, judge: Judge) -> dict[int, tuple[str, str]]:
        return {} if judge.number is None else places_of_judge(judge.number, self._study)

    def _next_place(self, judge: Judge) -> int | None:
        """Return the first place without an answer; None: all have one, or none may be seen yet."""
        places = self._places(judge)
        last = self._store.last_place(judge)
        place = min(places, default=0) if last is None else last + 1
        return place if place in places else None

    def _state(self, judge: Judge) -> web.Response:
        hears = judge.number is not None
        return web.json_response({"hears": hears, "place": self._next_place(judge)})


async def serve(
    study: Study, store: Store, config: GatewayConfig, on_ready: Callable[[str], None]
) -> None:
    """Serve a study until SIGINT or SIGTERM.

    Parameters
    ----------
    study, store
        The videos, and where answers go.
    config
        Where, and who may connect: the gateway's.
    on_ready
        Called with the page's address.

    Raises
    ------
    UserError
        If the address cannot be had, or the certificate not be read.
    """
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    listening = bind_port(config.host, config.port)
    endpoint = make_page_endpoint(config, listening.getsockname()[1])
    server = WebServer(
        listening,
        endpoint.tls,
        on_refused=lambda address: LOG.warning("refused a connection of %s: too many", address),
        on_bad_request=lambda: LOG.warning("dropped a request: it is not HTTP"),
        address_share=config.address_share,
    )
    await server.start(ListeningTest(study, store).make_application(endpoint.access), ())
    on_ready(endpoint.url)
    await stop.wait()
    await server.stop()


async def _serve_page(request: web.Request) -> web.StreamResponse:
    path = FILES.get(request.match_info.get("name", "index.html"))
    if path is None:
        raise web.HTTPNotFound
    return web.FileResponse(path, headers={"Content-Security-Policy": _POLICY})


async def _read(request: web.Request, *integers: str) -> dict[str, Any]:
    """Return the fields of a request's JSON, some of which must be integers."""
    try:
        fields: dict[str, Any] = await request.json()
        values = [fields[name] for name in integers]
    except (ValueError, TypeError, KeyError, RecursionError):
        values = [None]
    if not all(type(value) is int and abs(value) < 2**31 for value in values):
        raise web.HTTPBadRequest(text=f"send JSON with integers: {', '.join(integers)}\n")
    return fields
