"""VTube Studio's public API 1.0 (https://github.com/DenchiSoft/VTubeStudio): a face for Live2D.

The API is JSON over a WebSocket. The first time, the user allows kouxing in a VTube Studio window,
which issues a token for later connections. Then kouxing requests the list of tracking parameters
and sets those of ``tracking_parameters`` that exist in every frame. The model's own settings define
what they move.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

from kouxing.services.senders.face_frame import FaceFrame
from kouxing.shared.errors import UserError

PLUGIN = {"pluginName": "kouxing", "pluginDeveloper": "kouxing"}
_ACCESS_OFF, _UNAUTHENTICATED, _DENIED, _ASKING, _IN_USE = 1, 8, 50, 51, 454  # error IDs


class Denied(UserError):
    """The user denied access to VTube Studio."""


class Dialogue:
    """The messages of one connection, without I/O.

    Parameters
    ----------
    token
        Token from an earlier connection; if empty, VTube Studio asks the user.
    save_token
        Called with a new token.

    Attributes
    ----------
    is_ready
        Whether frames may be sent.
    problem
        Text for the user; empty if there is no problem.
    """

    def __init__(self, token: str, save_token: Callable[[str], None]) -> None:
        self._token = token
        self._save_token = save_token
        self._known: frozenset[str] = frozenset()
        self.is_ready = False
        self.problem = ""

    def first_message(self) -> str:
        """Return the first message."""
        if self._token:
            return _request("AuthenticationRequest", **PLUGIN, authenticationToken=self._token)
        self.problem = "VTube Studio asks whether kouxing may move the model: press Allow there"
        return _request("AuthenticationTokenRequest", **PLUGIN)

    def reply(self, text: str) -> str:
        """Process a message from VTube Studio; return the reply, or an empty text.

        Raises
        ------
        Denied
            If the user denies access.
        UserError
            If the message is invalid, or reports an error that requires a new connection.
        """
        try:
            message = json.loads(text)
            kind, data = message["messageType"], message["data"]
            handlers = {
                "AuthenticationTokenResponse": self._on_token,
                "AuthenticationResponse": self._on_authenticated,
                "InputParameterListResponse": self._on_parameters,
                "InjectParameterDataResponse": self._on_injected,
                "APIError": self._on_error,
            }
            return handlers[kind](data) if kind in handlers else ""
        except (ValueError, KeyError, TypeError, AttributeError):
            raise UserError("the program at this address is not VTube Studio") from None

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
                if name in self._known
            ],
        )

    def _on_token(self, data: Any) -> str:
        self._token = data["authenticationToken"]
        self._save_token(self._token)
        return self.first_message()

    def _on_authenticated(self, data: Any) -> str:
        if not data["authenticated"]:  # the user revoked it
            self._token = ""
            return self.first_message()
        self.problem = ""
        return _request("InputParameterListRequest")

    def _on_parameters(self, data: Any) -> str:
        parameters = [*data["defaultParameters"], *data["customParameters"]]
        self._known = frozenset(parameter["name"] for parameter in parameters)
        self.is_ready = True
        return ""

    def _on_injected(self, _data: Any) -> str:
        self.problem = ""
        return ""

    def _on_error(self, data: Any) -> str:
        number, text = data["errorID"], str(data["message"])[:200]
        if number == _DENIED:
            raise Denied(
                "access to VTube Studio was denied; stop and start sending to be asked again"
            )
        if number == _ACCESS_OFF:
            text = "VTube Studio's API is off: turn on 'Start API (allow plugins)' in its settings"
        elif number == _ASKING:
            text = self.problem  # it still shows the window of an earlier connection
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
