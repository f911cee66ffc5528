"""WebRTC without the packages it needs."""

from __future__ import annotations

import asyncio
import sys
from typing import Any

import aiohttp
import pytest
from aiohttp import web

from kouxing.services.gateway.whip import MISSING, WhipClients

pytestmark = pytest.mark.process


def test_without_its_packages_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "aiortc", None)
    monkeypatch.delitem(sys.modules, "kouxing.services.gateway.webrtc", raising=False)
    nothing: Any = None
    clients = WhipClients(1.0, nothing, nothing, ["127.0.0.1"])

    async def post() -> tuple[int, str]:
        application = web.Application()
        application.add_routes([web.post("/whip", clients.serve_post)])
        runner = web.AppRunner(application)
        await runner.setup()
        site = web.TCPSite(runner, "127.0.0.1", 0)
        await site.start()
        headers = {"Content-Type": "application/sdp"}
        url = f"http://127.0.0.1:{runner.addresses[0][1]}/whip"
        async with aiohttp.ClientSession() as http, http.post(url, headers=headers) as answer:
            told = answer.status, await answer.text()
        await runner.cleanup()
        return told

    assert asyncio.run(post()) == (501, MISSING)
    assert len(clients) == 0
