"""Checks the names in the settings of a face; the synthesizer checks its lip models."""

from kouxing.shared.errors import Rejected, UserError
from kouxing.shared.face.expressions import check_expressions
from kouxing.shared.face.shape_names import ShapeSetName
from kouxing.shared.wire.face import FaceSettings
from kouxing.shared.wire.session import ErrorCode
from kouxing.shared.wire.speech import AcousticModelName


def check_face(settings: FaceSettings) -> None:
    """Raise ``Rejected`` if a setting has an unknown name; the text lists the names."""
    known: list[tuple[str, str | None, list[str]]] = [
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
