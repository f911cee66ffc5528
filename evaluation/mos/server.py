"""The server of a listening test.

``POST /judges`` adds a judge. ``GET /state`` returns the study's title and number of videos, and
the judge's next place (negative: practice, null: none). ``GET /stimulus/PLACE`` sends the video of
the next place, and ``POST /answers`` saves its scores. No request names a file or a condition, so
judges cannot find out which condition they see.
"""

import asyncio
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from aiohttp import web

from kouxing.evaluation.mos.store import Answer, AnswerStore
from kouxing.evaluation.mos.study import LANGUAGES, SCALES, Study, places_of_judge
from kouxing.services.gateway.config import GatewayConfig
from kouxing.services.gateway.web import web_application
from kouxing.services.gateway.web.access import AccessPolicy
from kouxing.services.gateway.web.page_endpoint import make_page_endpoint
from kouxing.services.gateway.web.web_server import WebServer, bind_port
from kouxing.shared.files.user_file import parse_json

FOLDER = Path(__file__).parent / "page"
FILES = {name: FOLDER / name for name in ("index.html", "main.js", "style.css")}
FILES |= {
    name: web_application.PAGE_FOLDER / name
    for name in ("language.js", "texts.js", "gateway-texts.js", "icon.svg")
}
MAX_BODY_BYTES = 1024
_POLICY = "default-src 'self'; object-src 'none'; base-uri 'none'; frame-ancestors 'none'"


class ListeningTest:
    """Handles the requests of judges."""

    def __init__(self, study: Study, store: AnswerStore) -> None:
        self._study = study
        self._store = store

    def make_application(self, access: AccessPolicy) -> web.Application:
        """Return the web application."""
        routes = [
            web.post("/judges", self._add_judge),
            web.get("/state", self._show_state),
            web.get("/stimulus/{place}", self._send_video),
            web.post("/answers", self._add_answer),
        ]
        application = web.Application(
            middlewares=[access.middleware({route.path for route in routes})],
            client_max_size=MAX_BODY_BYTES,
        )
        application.add_routes([*routes, web.get("/", _send_file), web.get("/{name}", _send_file)])
        return application

    async def _add_judge(self, _request: web.Request) -> web.Response:
        token = self._store.add_judge()
        if token is None:
            raise web.HTTPServiceUnavailable(text="this study has enough judges\n")
        return web.json_response({"judge": token})

    async def _show_state(self, request: web.Request) -> web.Response:
        state: dict[str, object] = {
            "title": self._study.folder.name,
            "videos": len(self._study.files),
        }
        if "judge" in request.query:
            state["place"] = self._next_place(self._judge(request))
        return web.json_response(state)

    async def _send_video(self, request: web.Request) -> web.StreamResponse:
        judge = self._judge(request)
        place = self._next_place(judge)
        if place is None or request.match_info["place"] != str(place):
            raise web.HTTPNotFound
        file = self._study.files[places_of_judge(judge, self._study)[place]]
        return web.FileResponse(file, web_application.CHUNK_BYTES)

    async def _add_answer(self, request: web.Request) -> web.Response:
        judge, answer = self._judge(request), await _read_answer(request)
        next_place = self._next_place(judge)
        if next_place is not None and answer["place"] == next_place:
            cell = places_of_judge(judge, self._study)[next_place]
            end = answer["language"], time.time()
            self._store.add(
                [Answer(judge, next_place, *cell, scale, answer[scale], *end) for scale in SCALES]
            )
        elif next_place is not None and answer["place"] > next_place:
            raise web.HTTPConflict(text=f"place {next_place} comes first\n")
        return await self._show_state(request)

    def _judge(self, request: web.Request) -> int:
        judge = self._store.judges.get(request.query.get("judge", ""))
        if judge is None:
            raise web.HTTPNotFound(text="unknown judge; open the study's address again\n")
        return judge

    def _next_place(self, judge: int) -> int | None:
        places, last = places_of_judge(judge, self._study), self._store.last_places.get(judge)
        place = min(places) if last is None else last + 1
        return place if place in places else None


async def serve(
    study: Study, store: AnswerStore, config: GatewayConfig, on_ready: Callable[[str], None]
) -> None:
    """Serve a study until SIGINT or SIGTERM, with the gateway's address and access rules.

    ``on_ready`` is called with the page's address. Raises ``UserError`` if the address is not
    available, or the certificate cannot be read.
    """
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    listening = bind_port(config.host, config.port)
    endpoint = make_page_endpoint(config, listening.getsockname()[1])
    server = WebServer(listening, endpoint.tls, config.address_share)
    await server.start(ListeningTest(study, store).make_application(endpoint.access), ())
    on_ready(endpoint.url)
    await stop.wait()
    await server.stop()


async def _send_file(request: web.Request) -> web.StreamResponse:
    path = FILES.get(request.match_info.get("name", "index.html"))
    if path is None:
        raise web.HTTPNotFound
    return web.FileResponse(path, headers={"Content-Security-Policy": _POLICY})


async def _read_answer(request: web.Request) -> dict[str, Any]:
    try:
        answer: dict[str, Any] = parse_json(await request.read())
        numbers = [answer[name] for name in ("place", *SCALES)]
        is_valid = all(type(number) is int for number in numbers)
        if is_valid and {*numbers[1:]} <= {1, 2, 3, 4, 5} and answer["language"] in LANGUAGES:
            return answer
    except (ValueError, TypeError, KeyError):
        pass
    raise web.HTTPBadRequest(text="send JSON with a place, scores of 1 to 5, and a language\n")
