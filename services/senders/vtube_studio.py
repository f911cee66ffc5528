"""VTube Studio's public API 1.0 (https://github.com/DenchiSoft/VTubeStudio): a face for Live2D.

The API is JSON over a WebSocket. The first time, the user allows kouxing in a VTube Studio window,
which issues a token for later connections. Then kouxing requests the list of tracking parameters
and sets the ``tracking_parameters`` that exist, in every frame. The model's own settings define
what they move. The package pyvts is not used; its last release was in 2024.
"""

import asyncio
import json
import math
from collections.abc import Callable
from typing import Any

import aiohttp

from kouxing.services.senders.connection import RETRY_S, TargetConnection
from kouxing.services.senders.face_frame import FaceFrame
from kouxing.services.senders.target import Target
from kouxing.shared.errors import UserError
from kouxing.shared.files.output_file import write_private
from kouxing.shared.files.user_file import parse_json, read_text
from kouxing.shared.monitoring.logs import LOG
from kouxing.shared.settings.endpoints import is_loopback
from kouxing.shared.settings.keys import key_folder

_TOKENS = "vtube-studio.json"
_MAX_TOKENS_BYTES = 1 << 20
TIMEOUT_S = 5.0  # limit for a connection attempt, and for sending a frame

PLUGIN = {"pluginName": "kouxing", "pluginDeveloper": "kouxing"}
_ACCESS_OFF, _UNAUTHENTICATED, _DENIED, _ASKING, _IN_USE = 1, 8, 50, 51, 454  # error IDs


class AccessDenied(UserError):
    """The user denied access to VTube Studio."""


class VTubeStudioProtocol:
    """The messages of one connection, without I/O.

    ``token`` is from an earlier connection; if it is empty, VTube Studio asks the user. Frames may
    be sent while ``is_ready``. ``problem`` is a text for the user, or empty.
    """

    def __init__(self, token: str, save_token: Callable[[str], None]) -> None:
        self._token = token
        self._save_token = save_token
        self._existing_parameters: frozenset[str] = frozenset()
        self.is_ready = False
        self.problem = ""

    def first_message(self) -> str:
        """Return the first message."""
        if self._token:
            return _request("AuthenticationRequest", **PLUGIN, authenticationToken=self._token)
        self.problem = (
            "VTube Studio is asking whether kouxing may move the model; press Allow there"
        )
        return _request("AuthenticationTokenRequest", **PLUGIN)

    def reply(self, text: str) -> str:
        """Process a message from VTube Studio; return the reply, or an empty text.

        Raises ``AccessDenied`` if the user denies access, and ``UserError`` if the message is
        invalid or reports an error that requires a new connection.
        """
        try:
            message = parse_json(text)
            kind, data = message["messageType"], message["data"]
            handlers = {
                "AuthenticationTokenResponse": self._on_token,
                "AuthenticationResponse": self._on_authenticated,
                "InputParameterListResponse": self._on_parameters,
                "InjectParameterDataResponse": self._on_parameters_injected,
                "APIError": self._on_error,
            }
            return handlers[kind](data) if kind in handlers else ""
        except (ValueError, KeyError, TypeError, AttributeError):
            raise UserError(
                "the program at this address is not VTube Studio; check the port in its settings"
                " (8001 by default)"
            ) from None

    def frame_message(self, frame: FaceFrame, *, is_mouth_only: bool) -> str:
        """Return the message that shows a frame."""
        values = tracking_parameters(frame, is_mouth_only=is_mouth_only)
        return _request(
            "InjectParameterDataRequest",
            faceFound=not is_mouth_only,
            mode="set",
            parameterValues=[
                {"id": name, "value": value}
                for name, value in values.items()
                if name in self._existing_parameters
            ],
        )

    def _on_token(self, data: Any) -> str:
        self._token = data["authenticationToken"]
        self._save_token(self._token)
        return self.first_message()

    def _on_authenticated(self, data: Any) -> str:
        if not data["authenticated"]:  # the user revoked the token
            self._token = ""
            return self.first_message()
        self.problem = ""
        return _request("InputParameterListRequest")

    def _on_parameters(self, data: Any) -> str:
        parameters = [*data["defaultParameters"], *data["customParameters"]]
        self._existing_parameters = frozenset(parameter["name"] for parameter in parameters)
        self.is_ready = True
        return ""

    def _on_parameters_injected(self, _data: Any) -> str:
        self.problem = ""
        return ""

    def _on_error(self, data: Any) -> str:
        number, text = data["errorID"], str(data["message"])[:200]
        if number == _DENIED:
            raise AccessDenied(
                "access to VTube Studio was denied; to get the prompt again, stop and restart"
                " sending"
            )
        if number == _ACCESS_OFF:
            text = "VTube Studio's API is off; turn on 'Start API (allow plugins)' in its settings"
        elif number == _ASKING:
            text = self.problem  # VTube Studio still shows the window of an earlier connection
        elif number == _IN_USE:
            text = f"another plugin sets the same parameters: {text}"
        if not self.is_ready or number == _UNAUTHENTICATED:  # the token may have been revoked
            raise UserError(text)
        self.problem = text
        return ""


def tracking_parameters(frame: FaceFrame, *, is_mouth_only: bool) -> dict[str, float]:
    """Return tracking parameters by their names in VTube Studio.

    ``MouthSmile`` is 0.5 at rest, lower for a rounded mouth, higher for a wide one. Brows are also
    0.5 at rest. Gaze is -1 to 1 and rises to the face's right; ``FaceAngleX`` rises to its left.
    VTube Studio's own bindings invert the gaze.
    """
    arkit, vowels = frame.weights("arkit"), frame.weights("vrm")
    smile = (arkit["mouthSmileLeft"] + arkit["mouthSmileRight"]) / 2
    wide = vowels["ih"] + vowels["ee"] - vowels["ou"] - vowels["oh"]
    form = min(max(0.5 + 0.5 * (smile + wide), 0.0), 1.0)
    values = {
        "MouthOpen": frame.opening,
        "VoiceVolumePlusMouthOpen": frame.opening,
        "MouthSmile": form,
        "VoiceFrequencyPlusMouthSmile": form,
        "VoiceA": vowels["aa"],
        "VoiceI": vowels["ih"],
        "VoiceU": vowels["ou"],
        "VoiceE": vowels["ee"],
        "VoiceO": vowels["oh"],
        "JawOpen": arkit["jawOpen"],
        "CheekPuff": arkit["cheekPuff"],
        "TongueOut": arkit["tongueOut"],
    }
    if not is_mouth_only:
        pitch, yaw, roll = map(math.degrees, frame.head)
        brows = [
            0.5
            + (arkit["browInnerUp"] + arkit[f"browOuterUp{side}"]) / 4
            - arkit[f"browDown{side}"] / 2
            for side in ("Left", "Right")
        ]
        values |= {
            "EyeLeftX": arkit["eyeLookInLeft"] - arkit["eyeLookOutLeft"],
            "EyeLeftY": arkit["eyeLookUpLeft"] - arkit["eyeLookDownLeft"],
            "EyeRightX": arkit["eyeLookOutRight"] - arkit["eyeLookInRight"],
            "EyeRightY": arkit["eyeLookUpRight"] - arkit["eyeLookDownRight"],
            "BrowLeftY": brows[0],
            "BrowRightY": brows[1],
            "Brows": sum(brows) / 2,
            "EyeOpenLeft": 1.0 - arkit["eyeBlinkLeft"],
            "EyeOpenRight": 1.0 - arkit["eyeBlinkRight"],
            "FaceAngleX": yaw,
            "FaceAngleY": -pitch,
            "FaceAngleZ": -roll,
        }
    return values


def _request(kind: str, **data: object) -> str:
    return json.dumps(
        {
            "apiName": "VTubeStudioPublicAPI",
            "apiVersion": "1.0",
            "requestID": "kouxing",
            "messageType": kind,
            "data": data,
        }
    )


class VTubeStudioConnection(TargetConnection):
    """Sends the newest frame whenever the WebSocket is ready."""

    default_port = 8001
    contents = "tracking parameters"

    def __init__(self, target: Target) -> None:
        super().__init__(target)
        self._address = f"{target.host}:{target.port}"
        host = "127.0.0.1" if is_loopback(target.host) else target.host
        self._token_name = f"{host}:{target.port}"
        self._newest_frame: asyncio.Queue[FaceFrame] = asyncio.Queue(1)
        self._is_ready = False

    async def run(self) -> None:
        """Connect repeatedly, until the user denies access."""
        async with aiohttp.ClientSession() as http:
            while True:
                try:
                    await self._run_connection(http)
                    self.problem = "VTube Studio closed the connection; trying again"
                except UserError as error:
                    self.problem = str(error)
                    if isinstance(error, AccessDenied):
                        return
                except (aiohttp.ClientError, OSError, TimeoutError):
                    self.problem = (
                        f"VTube Studio is not running at {self._address}; start it, and turn on "
                        "'Start API (allow plugins)' in its settings"
                    )
                finally:
                    self._is_ready = False
                await asyncio.sleep(RETRY_S)

    def send(self, frame: FaceFrame) -> bool:
        """Queue a frame; it replaces a queued frame."""
        if not self._is_ready:
            return False
        if self._newest_frame.full():
            self._newest_frame.get_nowait()
        self._newest_frame.put_nowait(frame)
        return True

    async def _run_connection(self, http: aiohttp.ClientSession) -> None:
        limit = aiohttp.ClientWSTimeout(ws_close=RETRY_S)
        host = f"[{self.target.host}]" if ":" in self.target.host else self.target.host
        async with asyncio.timeout(TIMEOUT_S):
            vtube_studio = await http.ws_connect(f"ws://{host}:{self.target.port}", timeout=limit)
        async with vtube_studio:
            token = _read_tokens().get(self._token_name, "")
            protocol = VTubeStudioProtocol(token, self._save_token)
            writer: asyncio.Task[None] | None = None
            try:
                await vtube_studio.send_str(protocol.first_message())
                self.problem = protocol.problem
                async for message in vtube_studio:
                    if message.type is not aiohttp.WSMsgType.TEXT:
                        continue
                    reply = protocol.reply(message.data)
                    self.problem = protocol.problem
                    if reply:
                        await vtube_studio.send_str(reply)
                    elif protocol.is_ready and writer is None:
                        self._is_ready = True
                        writer = asyncio.create_task(self._write(vtube_studio, protocol))
            finally:
                if writer is not None:
                    writer.cancel()
                    await asyncio.gather(writer, return_exceptions=True)

    async def _write(
        self, vtube_studio: aiohttp.ClientWebSocketResponse, protocol: VTubeStudioProtocol
    ) -> None:
        try:
            while True:
                frame = await self._newest_frame.get()
                message = protocol.frame_message(frame, is_mouth_only=self.target.is_mouth_only)
                async with asyncio.timeout(TIMEOUT_S):
                    await vtube_studio.send_str(message)
        except TimeoutError:  # VTube Studio hangs, or its computer sleeps
            await vtube_studio.close()

    def _save_token(self, token: str) -> None:
        path = key_folder() / _TOKENS
        try:
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            write_private(path, json.dumps({**_read_tokens(), self._token_name: token}).encode())
        except OSError as error:
            LOG.warning("cannot write %s, so VTube Studio will ask again: %s", path, error.strerror)


def _read_tokens() -> dict[str, str]:
    """Return the tokens issued by VTube Studio, by its address."""
    try:
        tokens = parse_json(read_text(key_folder() / _TOKENS, _MAX_TOKENS_BYTES))
    except (UserError, ValueError):
        return {}
    return tokens if isinstance(tokens, dict) else {}
