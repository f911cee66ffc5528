"""Options and choices that several commands share."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from kouxing.services.driver.config import Framing
from kouxing.services.heads import DEFAULT_HEAD, HEAD_NAMES
from kouxing.shared.errors import UserError
from kouxing.shared.face.lip_constants import DEFAULT_LIP_MODEL
from kouxing.shared.face.shape_names import ShapeSetName
from kouxing.shared.phones.alphabets import Alphabet
from kouxing.shared.phones.inventory import find_language, language_codes


class Panel(StrEnum):
    """Parts of the list of all commands, in their order."""

    RUN = "Run and speak"
    RECORDINGS = "Recordings (no running system is needed)"
    MEASURE = "Measure and train"
    SERVICES = "A single service (run starts all of them)"


def _find_language(name: str | None) -> str | None:
    return None if name is None else find_language(name)


HeadName = Annotated[
    str,
    typer.Option(
        "--head", help=f"Head: {', '.join(HEAD_NAMES)}, or an avatar (.glb, .gltf, .vrm or .npz)."
    ),
]
AudioTrack = Annotated[
    int | None,
    typer.Option(
        "--track",
        metavar="N",
        help="Number of the file's audio track, from 1. Default: the file's default track.",
    ),
]
Language = Annotated[
    str | None,
    typer.Option(
        "--language",
        callback=_find_language,
        help=f"Language of the speech: {', '.join(language_codes())}, or an installed language;"
        " auto is any language. Default: zh.",
    ),
]
PhoneAlphabet = Annotated[
    Alphabet | None,
    typer.Option(
        "--alphabet",
        help="Alphabet of the phones: own (the language's symbols), ipa, or arpabet (English only)."
        " Default: own for zh, ipa for other languages.",
    ),
]
ACOUSTIC_MODEL = "Acoustic model: blocks, light, gmm, universal, or a model file"  # for help texts
Output = Annotated[Path | None, typer.Option("--output", "-o", help="File to write.")]
MouthFile = Annotated[
    Path | None, typer.Option("--mouth", help="Mouth profile of the speaker, from kouxing adapt.")
]
ConfigFile = Annotated[
    Path | None, typer.Option("--config", help="TOML file with one table per service.")
]
Assignments = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="[SERVICE.]KEY=VALUE",
        help="Set one key, as listed by 'kouxing config'; repeatable. Commands of one service also"
        " take KEY=VALUE.",
    ),
]


class CurveFormat(StrEnum):
    """Values of a face's curves."""

    FAPS = "faps"
    ARKIT = ShapeSetName.ARKIT
    OCULUS = ShapeSetName.OCULUS
    VRM = ShapeSetName.VRM
    RHUBARB = "rhubarb"  # drawn mouths, A to H and X, of Rhubarb Lip Sync
    LIVELINK = "livelink"  # ARKit and head angles, as the Live Link Face app records them


class ListenFormat(StrEnum):
    """Values that ``kouxing listen`` prints or records: ``CurveFormat``, and speech."""

    FAPS = CurveFormat.FAPS
    ARKIT = CurveFormat.ARKIT
    OCULUS = CurveFormat.OCULUS
    VRM = CurveFormat.VRM
    RHUBARB = CurveFormat.RHUBARB
    LIVELINK = CurveFormat.LIVELINK
    SYLLABLES = "syllables"
    PHONES = "phones"


SPEECH_FORMATS = (ListenFormat.SYLLABLES, ListenFormat.PHONES)


class CaptionKind(StrEnum):
    """Content of a video's captions."""

    PINYIN = "pinyin"
    CHARACTERS = "characters"
    PHONES = "phones"


class WidthSource(StrEnum):
    """Source of the width of a mouth that is drawn in two dimensions."""

    VISEMES = "dynamic-visemes"
    LEARNED = "learned"
    FERGUSON = "ferguson"  # always the same width, as in the paper


class TimingMethod(StrEnum):
    """Method that times the phones of a text."""

    ENDPOINTS = "endpoints"  # energy and zero crossings
    ALIGN = "align"  # forced alignment with the acoustic model


def reject_options(reason: str, **options: object) -> None:
    """Raise ``UserError`` with a reason if one of the named options was given."""
    for name, value in options.items():
        if value is not None and value is not False and value != "":  # 0 was given
            raise UserError(f"--{name.replace('_', '-')} {reason}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions:
    """How ``kouxing render`` shows and writes a face, with the defaults of its options."""

    lips: tuple[str, ...] = (DEFAULT_LIP_MODEL,)
    curve_format: CurveFormat | None = None  # None: the first one of the format
    head: str = DEFAULT_HEAD
    size: str = "1280x720"
    background: str = "studio"
    camera: Framing = Framing.FACE
    rate_hz: float | None = None  # frames per second; None: the default of the motion
    at_s: float | None = None  # time of a single picture
    sound: Path | None = None  # sound to add to curves
    captions: CaptionKind | None = None
    speed: float = 1.0
