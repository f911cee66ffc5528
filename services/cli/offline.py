"""The commands that need no running services: files in, files out."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from services.cli.heads import DEFAULT_HEAD, HeadName
from services.cli.terminal import CONSOLE, VoiceFile, print_message, write_output
from services.driver.config import Framing
from shared.errors import UserError
from shared.face.lip_models import LipModelName

Audio = Annotated[Path, typer.Argument(help="Audio file.")]
Acoustic = Annotated[str, typer.Option(help="Model: neural, blocks, gmm, or a file.")]


class PhoneFormat(StrEnum):
    """How phones are written."""

    TABLE = "table"
    CSV = "csv"
    JSON = "json"
    TEXTGRID = "textgrid"


class Timing(StrEnum):
    """What tells when the phones of a text are spoken."""

    ENDPOINTS = "endpoints"  # energy and zero crossings
    ALIGN = "align"  # the acoustic model


Form = Annotated[
    PhoneFormat | None,
    typer.Option("--format", help="If not given, the file's suffix tells, else a table."),
]
Output = Annotated[Path | None, typer.Option("--output", "-o", help="File to write.")]
_FORM_OF_SUFFIX = {f".{form.value}": form for form in PhoneFormat}


def render(
    source: Annotated[Path, typer.Argument(metavar="SOUND|FAP", help="Audio or .fap file.")],
    output: Annotated[
        Path,
        typer.Argument(
            help="Video (.mp4, .mov, .webm, silent .webp), one picture (.png), or a picture for"
            " every image (a folder, or a name with a number: face%05d.png)."
        ),
    ],
    lips: Annotated[
        list[LipModelName] | None,
        typer.Option(help="Lip model for a sound; repeated: faces side by side, with captions."),
    ] = None,
    head: HeadName = DEFAULT_HEAD,
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT in pixels.")] = "1280x720",
    background: Annotated[
        str, typer.Option(help="studio, transparent (not .mp4), #rrggbb, or a colour's name.")
    ] = "studio",
    camera: Annotated[Framing, typer.Option(help="What fills the picture.")] = Framing.FACE,
    yaw: Annotated[
        float, typer.Option(min=-180, max=180, help="Camera round to the face's left, degrees.")
    ] = 0.0,
    pitch: Annotated[float, typer.Option(min=-80, max=80, help="Camera up, degrees.")] = 0.0,
    rate: Annotated[
        float | None,
        typer.Option(min=1, max=240, help="Images per second; else 25, or those of the .fap file."),
    ] = None,
    sound: Annotated[Path | None, typer.Option(help="Sound for a .fap file.")] = None,
    at: Annotated[float | None, typer.Option(help="When one picture is taken, s.")] = None,
    voice: VoiceFile = None,
    expressiveness: Annotated[
        float | None,
        typer.Option(min=0.5, max=2, help="How large the mouth's movements are for a sound."),
    ] = None,
) -> None:
    """Make a video or pictures of an audio or FAP file."""
    from services.cli.rendering import Shot, render_file

    shot = Shot(
        head=head, size=size, background=background, camera=camera, yaw_deg=yaw, pitch_deg=pitch
    )
    render_file(
        source, output, shot, lips=lips, rate_hz=rate, sound=sound, at_s=at, voice=voice,
        expressiveness=expressiveness,
    )  # fmt: skip


def phones(
    audio: Audio, acoustic: Acoustic = "neural", form: Form = None, output: Output = None
) -> None:
    """Recognise an audio file: phones with their times."""
    from services.cli.sound_file import read_mono_16k
    from services.recognizer.acoustic.load import load_model, model_path
    from services.recognizer.offline import recognize
    from shared.clock import MEDIA_RATE_HZ
    from shared.phones.phone_files import format_phones

    samples = read_mono_16k(audio)
    duration_s = len(samples) / MEDIA_RATE_HZ
    with CONSOLE.status(f"recognising {duration_s:.0f} s"):
        found = recognize(load_model(model_path(acoustic)), samples, MEDIA_RATE_HZ)
    if not found:
        print_message(f"{audio}: no speech was found")
    write_output(format_phones(found, _form(form, output), duration_s), output)


def align(
    audio: Audio,
    text: Annotated[str, typer.Argument(help="What is said: Chinese characters, or pinyin.")],
    acoustic: Acoustic = "neural",
    form: Form = None,
    output: Output = None,
) -> None:
    """Find the times of the phones of a known text."""
    from services.cli.sound_file import read_mono_16k
    from services.recognizer.acoustic.load import load_model, model_path
    from services.recognizer.alignment import align_text
    from shared.clock import MEDIA_RATE_HZ
    from shared.phones.phone_files import format_phones

    samples = read_mono_16k(audio)
    aligned = align_text(load_model(model_path(acoustic)), samples, MEDIA_RATE_HZ, text)
    duration_s = len(samples) / MEDIA_RATE_HZ
    write_output(format_phones(aligned, _form(form, output), duration_s), output)


def lips(
    audio: Audio,
    text_and_output: Annotated[
        list[str],
        typer.Argument(
            metavar="[TEXT] OUTPUT",
            help="What is said, in Chinese characters or pinyin (else phones are recognised); then"
            " the file: .svg or .png (the mouth at every key frame), .mp4, or .csv (the contour).",
        ),
    ],
    timing: Annotated[
        Timing | None,
        typer.Option(help="What times a text: energy and zero crossings, or forced alignment."),
    ] = None,
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Smooth between key frames, not linear.")
    ] = False,
    points: Annotated[
        int, typer.Option(min=2, max=1000, help="Points of each of the four lines (.csv).")
    ] = 21,
    speech_to_text: Annotated[
        Path | None,
        typer.Option(help="Folder of a sherpa-onnx model, which tells what is said."),
    ] = None,
) -> None:
    """Draw the mouth alone, in two dimensions: for cartoons, teaching and papers."""
    from services.cli.mouth_drawing import draw_mouth

    *text, output = text_and_output
    if len(text) > 1:
        raise UserError("give one text and one output; put a text with spaces in quotes")
    draw_mouth(
        audio,
        text[0] if text else None,
        Path(output),
        timing=timing,
        smooth=smooth,
        num_points=points,
        speech_to_text=speech_to_text,
    )


def _form(form: PhoneFormat | None, output: Path | None) -> str:
    if form is None and output is not None:
        form = _FORM_OF_SUFFIX.get(output.suffix.lower())
    return (form or PhoneFormat.TABLE).value
