"""The settings that change a face."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from kouxing_client.field_types import Name, Probability, SessionName
from msgspec import Meta, Struct
from msgspec.structs import asdict

from kouxing.shared.face.expressions import (
    DEFAULT_HOLD_S,
    MAX_EXPRESSIVENESS,
    MAX_HOLD_S,
    MIN_EXPRESSIVENESS,
)
from kouxing.shared.fast_record import replace
from kouxing.shared.wire.message import RegisteredMessage

ExpressionMap = Annotated[dict[Name, float], Meta(max_length=32)]  # control checks them by name
ShapeSets = Annotated[list[Name], Meta(max_length=16)]


class FaceSettings(Struct, frozen=True, kw_only=True):
    """How a session's face moves. A setting without a value does not change."""

    lip_model: Name | None = None
    acoustic: Name | None = None  # an acoustic model: light, or full
    expressiveness: Annotated[float, Meta(ge=MIN_EXPRESSIVENESS, le=MAX_EXPRESSIVENESS)] | None = (
        None  # scales the mouth's motion; 1: as the lip model moves it
    )
    feeling: Probability | None = None  # strength of the voice's feeling on the face; 0: off
    still: bool | None = None  # the head and the brows do not move
    eye_contact: bool | None = None  # the eyes do not leave the viewer
    listen_to: SessionName | None = None  # session that the face listens to; "": none
    listening: bool | None = None  # another person speaks; control sets it with listen_to
    expressions: ExpressionMap | None = None  # strengths by name; {}: fade the current ones
    hold_s: Annotated[float, Meta(ge=0, le=MAX_HOLD_S)] = DEFAULT_HOLD_S  # until they fade
    shapes: ShapeSets | None = None  # also publish these sets of shapes

    def merged_with(self, change: FaceSettings) -> FaceSettings:
        """Return these settings after a change."""
        changed = {name: value for name, value in asdict(change).items() if value is not None}
        if change.expressions is None:
            del changed["hold_s"]  # it belongs to the expressions
        shapes = dict.fromkeys([*(self.shapes or ()), *(change.shapes or ())])
        changed["shapes"] = list(shapes) or None
        return replace(self, **changed)

    def after(self, elapsed_s: float) -> FaceSettings:
        """Return these settings some time later; expressions that began to fade are left out."""
        if self.expressions is None:
            return self
        hold_s = self.hold_s - elapsed_s
        if hold_s <= 0:
            return replace(self, expressions=None, hold_s=DEFAULT_HOLD_S)
        return replace(self, hold_s=hold_s)


@dataclass(slots=True)
class CurrentFace:
    """Face settings in effect, whose expressions fade with time."""

    settings: FaceSettings
    set_at_s: float

    def change(self, change: FaceSettings, now_s: float) -> None:
        """Apply a change."""
        self.settings, self.set_at_s = self.at(now_s).merged_with(change), now_s

    def at(self, now_s: float) -> FaceSettings:
        """Return the settings with which a new face would show the same."""
        return self.settings.after(now_s - self.set_at_s)


class SetFace(RegisteredMessage, frozen=True, kw_only=True):
    """Changes a session's face. Sent by a client to control, and by control to the services."""

    face: FaceSettings
    request: Name | None = None  # None: no answer is needed
