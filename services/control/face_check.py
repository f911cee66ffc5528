"""Checks the names in the settings of a face."""

from collections.abc import Collection

from kouxing.shared.errors import Rejected, UserError
from kouxing.shared.face.expressions import check_expressions
from kouxing.shared.face.shape_names import ShapeSetName
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE
from kouxing.shared.wire.face import FaceSettings
from kouxing.shared.wire.session import ErrorCode
from kouxing.shared.wire.speech import AcousticModelName


def check_face(settings: FaceSettings, lip_models: Collection[str], session: str = "") -> None:
    """Raise ``Rejected`` if a setting of a session's face is invalid.

    The error for an unknown name lists the known names. If ``lip_models`` is empty, any name of
    a lip model is allowed.
    """
    if session and settings.listen_to == session:
        text = f"face {session!r} cannot listen to itself; set listen_to to another session"
        raise Rejected(ErrorCode.BAD_FACE, text)
    known: list[tuple[str, str | None, Collection[str]]] = [
        ("lip model", settings.lip_model if lip_models else None, lip_models),
        ("acoustic model", settings.acoustic, [*AcousticModelName]),
        *(("set of shapes", name, [*ShapeSetName]) for name in settings.shapes or ()),
    ]
    for noun, name, names in known:
        if name is not None and name not in names:
            text = f"unknown {noun} {name!r}; use {', '.join(names)}"
            raise Rejected(ErrorCode.BAD_FACE, text)
    try:
        check_expressions(settings.expressions or {}, settings.hold_s)
    except UserError as error:
        raise Rejected(ErrorCode.BAD_FACE, str(error)) from None


def check_acoustic_model(settings: FaceSettings, language: str | None) -> None:
    """Raise ``Rejected`` if the chosen acoustic model does not have a session's language."""
    if settings.acoustic == AcousticModelName.LIGHT and language not in (None, DEFAULT_LANGUAGE):
        text = (
            f"the acoustic model light has only {DEFAULT_LANGUAGE}; leave out acoustic, because"
            f" this session's language is {language}"
        )
        raise Rejected(ErrorCode.BAD_FACE, text)
