"""VTube Studio's public API 1.0 (https://github.com/DenchiSoft/VTubeStudio): a face for Live2D.

JSON over a WebSocket. The first time the user allows kouxing in a window of VTube Studio, which
then gives a token; with the token later connections need no window. Then the parameters are asked
for, and those of ``parameters`` that exist are set in every frame. The model's own settings say
what they move.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

from kouxing.services.senders.face import Face
from kouxing.shared.errors import UserError

PLUGIN = {"pluginName": "kouxing", "pluginDeveloper": "kouxing"}
_ACCESS_OFF, _UNAUTHENTICATED, _DENIED, _ASKING, _IN_USE = 1, 8, 50, 51, 454  # numbers of errors


class Denied(UserError):
    """The user does not want kouxing in VTube Studio."""


class Dialogue:
    """What is said over one connection, and what the answers mean.

    Parameters
    ----------
    token
        From an earlier connection; empty: the user is asked.
    keep_token
        Called with a new token.

    Attributes
    ----------
    is_ready
        Whether frames may be sent.
    problem
        What the user should know; empty: all is well.
    """

    def __init__(self, token: str, keep_token: Callable[[str], None]) -> None:
        self._token = token
        self._keep_token = keep_token
        self._known: frozenset[str] = frozenset()
        self.is_ready = False
        self.problem = ""

    def begin(self) -> str:
        """Return the first message."""
        if self._token:
            return _request("AuthenticationRequest", **PLUGIN, authenticationToken=self._token)
        self.problem = "VTube Studio asks whether kouxing may move the model: press Allow there"
        return _request("AuthenticationTokenRequest", **PLUGIN)

    def answer(self, text: str) -> str:
        """Take a message of VTube Studio; return the one to send next, empty if there is none.

        Raises
        ------
        Denied
            If the user does not allow kouxing.
        UserError
            If it is no message of this API, or an error after which only a new connection helps.
        """
        try:
            message = json.loads(text)
            kind, data = message["messageType"], message["data"]
            answers = {
                "AuthenticationTokenResponse": self._on_token,
                "AuthenticationResponse": self._on_authenticated,
                "InputParameterListResponse": self._on_parameters,
                "InjectParameterDataResponse": self._on_injected,
                "APIError": self._on_error,
            }
            return answers[kind](data) if kind in answers else ""
        except (ValueError, KeyError, TypeError, AttributeError):
            raise UserError("what answers there is no VTube Studio") from None

    def frame(self, face: Face, *, is_mouth_only: bool) -> str:
        """Return the message that shows a face."""
        values = parameters(face, is_mouth_only=is_mouth_only)
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
        self._keep_token(self._token)
        return self.begin()

    def _on_authenticated(self, data: Any) -> str:
        if not data["authenticated"]:  # the user took it back
            self._token = ""
            return self.begin()
        self.problem = ""
        return _request("InputParameterListRequest")

    def _on_parameters(self, data: Any) -> str:
        found = [*data["defaultParameters"], *data["customParameters"]]
        self._known = frozenset(each["name"] for each in found)
        self.is_ready = True
        return ""

    def _on_injected(self, _data: Any) -> str:
        self.problem = ""
        return ""

    def _on_error(self, data: Any) -> str:
        number, text = data["errorID"], str(data["message"])[:200]
        if number == _DENIED:
            raise Denied("VTube Studio's user denied kouxing; stop and start to be asked again")
        if number == _ACCESS_OFF:
            text = "VTube Studio's API is off: turn on 'Start API (allow plugins)' in its settings"
        elif number == _ASKING:
            text = self.problem  # it still shows the question of an earlier connection
        elif number == _IN_USE:
            text = f"another plugin moves the same parameters: {text}"
        if not self.is_ready or number == _UNAUTHENTICATED:  # the token may have been taken back
            raise UserError(text)
        self.problem = text
        return ""


def parameters(face: Face, *, is_mouth_only: bool) -> dict[str, float]:
    """Return tracking parameters by their names in VTube Studio.

    ``MouthSmile`` is the form of the mouth, 0.5 at rest: less is rounded, more is wide. Brows are
    0.5 at rest, too. Gaze is -1 to 1, more to the face's right, while ``FaceAngleX`` is more to its
    left: VTube Studio's own bindings turn the former round.
    """
    arkit, vowels = face.weights("arkit"), face.weights("vrm")
    smile = (arkit["mouthSmileLeft"] + arkit["mouthSmileRight"]) / 2
    wide = vowels["ih"] + vowels["ee"] - vowels["ou"] - vowels["oh"]
    form = min(max(0.5 + 0.5 * (smile + wide), 0.0), 1.0)
    values = {
        "MouthOpen": face.opening,
        "VoiceVolumePlusMouthOpen": face.opening,
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
        pitch, yaw, roll = map(math.degrees, face.head)
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
