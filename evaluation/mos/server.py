"""The page that judges see: which video comes next, and their scores.

==========================  ==============================================================
request                     answer
==========================  ==============================================================
``GET /``, ``GET /NAME``    the page and its files
``GET /study``              its title, the page's languages and the number of videos
``POST /judges``            ``{"judge": token}``: a new judge
``GET /state``              ``{"hears": bool, "place": n}``: whether the sound check is passed, and
                            which place is next (null: none)
``GET /beeps``              WAV file of the sound check
``POST /beeps``             ``{"beeps": n}``, how many were heard: the state
``GET /stimulus/PLACE``     the judge's video at this place, if it is the next
``POST /answers``           ``{"place": n, "sync": 1..5, "realism": 1..5}``: the state
==========================  ==============================================================

Those below ``/judges`` take ``?judge=TOKEN``; all but the page's files take what ``Access`` asks
for. No request names a file or a condition: a judge's places do.
"""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable
from pathlib import Path

from aiohttp import web

from evaluation.mos.beeps import make_beeps
from evaluation.mos.order import order_of_judge
from evaluation.mos.store import Judge, Store
from evaluation.mos.study import SCALES, Study
from services.gateway import http
from services.gateway.access import Access
from services.gateway.config import GatewayConfig
from services.gateway.entrance import make_entrance
from services.gateway.listener import Listener, bind
from shared.logs import LOG

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

    def make_application(self, access: Access) -> web.Application:
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
            middlewares=[access.guard({route.path for route in routes})],
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
        (beeps,) = await _integers(request, "beeps")
        self._store.check_sound(self._judge(request), beeps)
        return self._state(self._judge(request))

    async def _play_stimulus(self, request: web.Request) -> web.StreamResponse:
        judge = self._judge(request)
        place = self._next_place(judge)
        if not judge.hears or place is None or request.match_info["place"] != str(place):
            raise web.HTTPNotFound
        return web.FileResponse(self._study.files[self._order(judge)[place]])

    async def _add_answer(self, request: web.Request) -> web.Response:
        judge = self._judge(request)
        place, *given = await _integers(request, "place", *SCALES)
        order = self._order(judge)
        place_due = self._next_place(judge)
        last = len(order) - 1 if place_due is None else place_due
        if not judge.hears or not 0 <= place <= last:
            raise web.HTTPConflict(text="this video is not due\n")
        if not all(1 <= score <= 5 for score in given):
            raise web.HTTPBadRequest(text="scores are 1 to 5\n")
        self._store.add(judge, *order[place], dict(zip(SCALES, given, strict=True)))
        return self._state(judge)

    def _judge(self, request: web.Request) -> Judge:
        judge = self._store.find_judge(request.query.get("judge", ""))
        if judge is None:
            raise web.HTTPNotFound(text="there is no such judge\n")
        return judge

    def _order(self, judge: Judge) -> list[tuple[str, str]]:
        return order_of_judge(judge.number, self._study.sentences, self._study.conditions)

    def _next_place(self, judge: Judge) -> int | None:
        """Return the place of the first video without an answer; None: all have one."""
        answered = self._store.answered(judge)
        places = (place for place, cell in enumerate(self._order(judge)) if cell not in answered)
        return next(places, None)

    def _state(self, judge: Judge) -> web.Response:
        return web.json_response({"hears": judge.hears, "place": self._next_place(judge)})


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
    listening = bind(config.host, config.port)
    entrance = make_entrance(config, listening.getsockname()[1])
    listener = Listener(
        listening,
        entrance.tls,
        on_refused=lambda address: LOG.warning("refused a connection of %s: too many", address),
        on_bad_request=lambda: LOG.warning("dropped a request: it is no HTTP"),
        share=config.address_share,
    )
    await listener.start(ListeningTest(study, store).make_application(entrance.access), ())
    on_ready(entrance.url)
    await stop.wait()
    await listener.stop()


async def _serve_page(request: web.Request) -> web.StreamResponse:
    path = FILES.get(request.match_info.get("name", "index.html"))
    if path is None:
        raise web.HTTPNotFound
    return web.FileResponse(path, headers={"Content-Security-Policy": _POLICY})


async def _integers(request: web.Request, *names: str) -> list[int]:
    """Return fields of a request's JSON, which must be integers."""
    try:
        fields = await request.json()
        values = [fields[name] for name in names]
    except (ValueError, TypeError, KeyError, RecursionError):
        values = [None]
    if not all(type(value) is int and abs(value) < 2**31 for value in values):
        raise web.HTTPBadRequest(text=f"send JSON with integers: {', '.join(names)}\n")
    return values
