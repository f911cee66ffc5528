"""The keywords of sessions and faces, and their checks before a request is sent."""

import difflib
import re
from collections.abc import Collection, Mapping, Sequence
from typing import TypedDict

from kouxing_client.audio import SAMPLE_BYTES
from kouxing_client.errors import KouxingError
from kouxing_client.field_types import SESSION_NAME
from kouxing_client.messages import MEDIA_RATE_HZ, Fields, Result, Shapes

MIN_RATE_HZ, MAX_RATE_HZ = 8000, 48000
MAX_CHANNELS = 2


class FaceSettings(TypedDict, total=False):
    """How a face moves. Omitted settings keep their values."""

    lip_model: str
    """name of the lip model"""
    acoustic: str
    """acoustic model: ``full``, or ``light``: less processor time, more errors, only Mandarin"""
    expressions: Mapping[str, float]
    """strengths from 0 to 1 by name; they replace the current ones, and ``{}`` removes them"""
    hold_s: float
    """time until the expressions fade, s"""
    expressiveness: float
    """scale of the mouth movements, 0.5 to 2"""
    feeling: float
    """how strongly the face shows the emotion in the voice, 0 to 1"""
    still: bool
    """whether to keep the head and the brows still"""
    eye_contact: bool
    """whether the eyes always look at the viewer"""
    listen_to: str
    """session that the face listens to, looking at the viewer and nodding in pauses; or ``""``"""
    listening: bool
    """whether a person without a session is speaking, so that the face listens"""
    shapes: Sequence[str]
    """blendshape sets to publish in addition to FAPs"""


class SessionOptions(TypedDict, total=False):
    """How to open a session."""

    sample_rate_hz: int
    """sample rate of the audio, 8000 to 48000; default: 16000"""
    num_channels: int
    """number of audio channels: 1 (the default) or 2"""
    encoding: str
    """sample format of pushed bytes and messages: ``s16le`` (the default) or ``f32le``"""
    paced: bool
    """whether audio arrives in real time; False: it arrives faster"""
    language: str | None
    """spoken language: ``auto``, a code or a name; None: the recognizer's"""
    shapes: Sequence[str]
    """sets of blendshapes to publish from the first frame on: ``arkit``, ``oculus``, ``vrm``"""
    face: FaceSettings
    """settings of the face"""
    mouth_profile: bytes | None
    """profile of the speaker, from ``kouxing adapt``"""
    record: bool
    """whether the driver writes a video"""


def open_fields(name: str, options: SessionOptions) -> Fields:
    """Return the fields of ``open-session``.

    Raises
    ------
    TypeError
        If a keyword is unknown.
    KouxingError
        If the name is not valid, the audio format is not supported, or ``shapes`` is a text.
    """
    _check_keywords("open_session", options, SessionOptions.__annotations__)
    check_name(name)
    fields: Fields = {
        "session": name,
        "sample_rate_hz": MEDIA_RATE_HZ,
        "num_channels": 1,
        "encoding": "s16le",
        **options,
    }
    if fields["encoding"] not in SAMPLE_BYTES:
        raise KouxingError(
            f"encoding must be one of {', '.join(SAMPLE_BYTES)}, not {fields['encoding']!r}"
        )
    _check_integer("sample_rate_hz", fields["sample_rate_hz"], MIN_RATE_HZ, MAX_RATE_HZ)
    _check_integer("num_channels", fields["num_channels"], 1, MAX_CHANNELS)
    face = face_fields(fields.pop("face", None) or {})
    if shapes := fields.pop("shapes", ()):
        _check_shapes(shapes)
        face["shapes"] = list(shapes)
    if face:
        fields["face"] = face
    return fields


def face_fields(settings: FaceSettings) -> Fields:
    """Return the settings of a face as a dictionary.

    Raises ``TypeError`` for unknown keywords, and ``KouxingError`` if ``shapes`` is a text, or if
    there is ``hold_s`` without ``expressions``.
    """
    _check_keywords("set_face", settings, FaceSettings.__annotations__)
    if "hold_s" in settings and "expressions" not in settings:
        raise KouxingError("hold_s is how long expressions last; pass it with expressions")
    _check_shapes(settings.get("shapes", ()))
    return {**settings}


def check_name(name: str) -> None:
    """Raise ``KouxingError`` if a text is not a valid session name; it may be empty."""
    if not (isinstance(name, str) and re.fullmatch(SESSION_NAME, name)):
        raise KouxingError(
            f"{name!r} is not a valid session name; use up to 64 letters, digits, '-' and '_'"
        )


def check_results(classes: Sequence[object], shape_set: str) -> None:
    """Raise ``KouxingError`` unless a session publishes results of these classes."""
    for cls in classes:
        if not (isinstance(cls, type) and issubclass(cls, Result)):
            raise KouxingError(f"results() expects classes such as FapFrame or Phone, not {cls!r}")
    if not classes or (Shapes in classes and not shape_set):
        raise KouxingError(
            "results() needs classes, such as results(FapFrame, Phone); Shapes also needs the name"
            " of a set, such as shapes='arkit'"
        )


def _check_keywords(function: str, given: Mapping[str, object], known: Collection[str]) -> None:
    for name in given:
        if name not in known:
            likely = difflib.get_close_matches(name, known, 1)
            hint = f"did you mean {likely[0]!r}?" if likely else f"use {', '.join(known)}"
            if "face" in known and name in FaceSettings.__annotations__:
                hint = f"write face={{{name!r}: ...}}"
            raise TypeError(f"{function}() has no keyword {name!r}; {hint}")


def _check_shapes(shapes: Sequence[str]) -> None:
    if isinstance(shapes, str):  # a text is also a sequence of texts
        raise KouxingError(f"shapes must be a list of sets, such as [{shapes!r}]")


def _check_integer(name: str, value: object, lowest: int, highest: int) -> None:
    if type(value) is not int or not lowest <= value <= highest:
        raise KouxingError(f"{name} must be an integer from {lowest} to {highest}, not {value!r}")
