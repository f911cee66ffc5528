"""A server that answers like VTube Studio, according to the public document of its API."""

from __future__ import annotations

import asyncio
import json
import re
import threading

from aiohttp import WSMsgType, web

Answer = tuple[str, dict[str, object]]  # kind and data
API = {"apiName": "VTubeStudioPublicAPI", "apiVersion": "1.0"}
MAX_VALUE = 1e6
PARAMETERS = ("MouthOpen", "MouthSmile", "EyeOpenLeft", "FaceAngleX", "MousePositionX")


class VTubeStudioStub:
    """A server in a thread, at a free port or a given one."""

    def __init__(self, port: int = 0, *, user_allows: bool = True, token: str = "") -> None:
        self.port = port
        self.requests: list[str] = []  # kinds of the received messages, except frames
        self.frames: list[dict[str, float]] = []  # parameters of each frame, by name
        self._user_allows = user_allows
        self.token = token  # the valid token; if it is empty, no token is valid
        self.is_asking = False  # whether a question to the user is open
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)

    def __enter__(self) -> VTubeStudioStub:
        self._thread.start()
        asyncio.run_coroutine_threadsafe(self._serve(), self._loop).result()
        return self

    def __exit__(self, *exc: object) -> None:
        asyncio.run_coroutine_threadsafe(self._runner.cleanup(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _serve(self) -> None:
        application = web.Application()
        application.router.add_get("/", self._talk)
        self._runner = web.AppRunner(application, shutdown_timeout=0.1)
        await self._runner.setup()
        site = web.TCPSite(self._runner, "127.0.0.1", self.port)
        await site.start()
        self.port = self._runner.addresses[0][1]

    async def _talk(self, request: web.Request) -> web.WebSocketResponse:
        client = web.WebSocketResponse()
        await client.prepare(request)
        authenticated_by = ""
        async for message in client:
            if message.type is not WSMsgType.TEXT:
                continue
            asked = json.loads(message.data)
            kind, data = asked.get("messageType"), asked.get("data", {})
            if kind == "AuthenticationRequest":
                authenticated_by = data.get("authenticationToken", "")
            is_authenticated = bool(self.token) and authenticated_by == self.token
            fault = _fault(asked) or _plugin_fault(kind, data)
            answered, answer = fault or self._answer(kind, data, is_authenticated)
            about = {"timestamp": 1625405710728, "requestID": asked.get("requestID", "")}
            await client.send_json({**API, **about, "messageType": answered, "data": answer})
        return client

    def _answer(self, kind: object, data: dict[str, object], is_authenticated: bool) -> Answer:
        if kind != "InjectParameterDataRequest":
            self.requests.append(str(kind))
        if kind == "AuthenticationTokenRequest":
            return self._give_token()
        if kind == "AuthenticationRequest":
            return "AuthenticationResponse", {"authenticated": is_authenticated, "reason": ""}
        if not is_authenticated:
            return _error(8, "This request requires authentication")
        if kind == "InputParameterListRequest":
            listed = [{"name": name, "value": 0.0, "min": 0, "max": 1} for name in PARAMETERS]
            answer: dict[str, object] = {"defaultParameters": listed, "customParameters": []}
            return "InputParameterListResponse", answer
        if kind == "InjectParameterDataRequest":
            return self._inject(data)
        return _error(7, f"Unknown request type: {kind}")

    def _give_token(self) -> Answer:
        if self.is_asking:
            return _error(51, "A permission popup is already shown.")
        if not self._user_allows:
            return _error(50, "User has denied API access for your plugin.")
        self.token = "a-token"  # noqa: S105 - of the stub
        return "AuthenticationTokenResponse", {"authenticationToken": self.token}

    def _inject(self, data: dict[str, object]) -> Answer:
        values = data.get("parameterValues")
        if not isinstance(values, list) or not values:
            return _error(450, "No data was provided")
        if data.get("mode", "set") not in ("set", "add"):
            return _error(455, "Unknown mode")
        frame = {value["id"]: value["value"] for value in values}
        if not all(isinstance(value, int | float) for value in frame.values()):
            return _error(451, "A value is not a number")
        if not all(abs(value) <= MAX_VALUE for value in frame.values()):
            return _error(451, "A value is out of range")
        if not frame.keys() <= {*PARAMETERS}:
            return _error(453, "Parameter not found")
        self.frames.append(frame)
        return "InjectParameterDataResponse", {}


def _fault(asked: dict[str, object]) -> Answer | None:
    """Return the error of an invalid request."""
    for number, key in ((3, "apiName"), (4, "apiVersion")):
        if asked.get(key) != API[key]:
            return _error(number, f"{key} must be {API[key]}")
    if not re.fullmatch("[0-9A-Za-z]{1,64}", str(asked.get("requestID", "-"))):
        return _error(5, "requestID must be alphanumeric, with 1 to 64 characters")
    return None


def _plugin_fault(kind: object, data: dict[str, object]) -> Answer | None:
    """Return the error of an invalid plugin name or token."""
    if kind not in ("AuthenticationTokenRequest", "AuthenticationRequest"):
        return None
    number = 52 if kind == "AuthenticationTokenRequest" else 101
    for name in ("pluginName", "pluginDeveloper"):
        if not 3 <= len(str(data.get(name, ""))) <= 32:
            return _error(number, f"{name} must have 3 to 32 characters")
        number += 1
    if kind == "AuthenticationRequest" and not data.get("authenticationToken"):
        return _error(100, "authenticationToken is missing")
    return None


def _error(number: int, text: str) -> Answer:
    return "APIError", {"errorID": number, "message": text}
