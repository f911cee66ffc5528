"""The commands that need no running services: files in, files out."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from kouxing.services.cli.options import DEFAULT_HEAD, CurveForm, HeadName, MouthFile, Timing
from kouxing.services.driver.config import Framing
from kouxing.shared.errors import UserError
from kouxing.shared.face.lip_models import DEFAULT_LIP_MODEL, LipModelName
from kouxing.shared.terminal import CONSOLE, print_message, write_output

Audio = Annotated[Path, typer.Argument(help="Audio or video file.")]
Acoustic = Annotated[str, typer.Option(help="Model: neural, blocks, gmm, or a file.")]


class PhoneFormat(StrEnum):
    """How phones are written."""

    TABLE = "table"
    CSV = "csv"
    JSON = "json"
    TEXTGRID = "textgrid"


Form = Annotated[
    PhoneFormat | None,
    typer.Option("--format", help="If not given, the file's suffix tells, else a table."),
]
Output = Annotated[Path | None, typer.Option("--output", "-o", help="File to write.")]
_FORM_OF_SUFFIX = {
    ".txt": PhoneFormat.TABLE,
    ".csv": PhoneFormat.CSV,
    ".json": PhoneFormat.JSON,
    ".textgrid": PhoneFormat.TEXTGRID,
}


def render(
    source: Annotated[Path, typer.Argument(metavar="SOUND|FAP", help="Audio, video or .fap file.")],
    output: Annotated[
        Path,
        typer.Argument(
            help="Video (.mp4, .mov, .webm, silent .webp), one picture (.png), a picture for"
            " every image (a folder, or a name with a number: face%05d.png), or the face's curves"
            " (.fap, .csv, .jsonl, or .glb: the head, animated)."
        ),
    ],
    lips: Annotated[
        list[LipModelName] | None,
        typer.Option(help="Lip model for a sound; repeated: faces side by side, with captions."),
    ] = None,
    live: Annotated[
        bool, typer.Option("--live", help="As a viewer of the stream would have seen it.")
    ] = False,
    text: Annotated[
        str | None,
        typer.Option(
            help="What is said (characters, pinyin, or a file with them): better lips. Recordings "
            "only: phones of a text are timed in the whole sound, so 'speak' takes none."
        ),
    ] = None,
    form: Annotated[
        CurveForm, typer.Option("--as", help="Values of a curve file.")
    ] = CurveForm.FAPS,
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
    mouth: MouthFile = None,
    expressiveness: Annotated[
        float | None,
        typer.Option(min=0.5, max=2, help="How large the mouth's movements are for a sound."),
    ] = None,
) -> None:
    """Make a video, pictures or curves of an audio or FAP file."""
    from rich.progress import Progress

    from kouxing.services.cli import curves
    from kouxing.services.cli.motion import is_fap, motion_of_sound, read_motion
    from kouxing.services.cli.rendering import Shot, check_pictures, draw, make_renderer

    faces = lips or [DEFAULT_LIP_MODEL]
    _check_source(
        source, lips=bool(lips), live=live, text=text is not None, mouth=mouth is not None,
        expressiveness=expressiveness is not None, sound=sound is not None,
    )  # fmt: skip
    shot = Shot(
        head=head, size=size, background=background, camera=camera, yaw_deg=yaw, pitch_deg=pitch,
        rate_hz=rate, at_s=at,
    )  # fmt: skip
    renderer = None
    if curves.is_curves(output):
        curves.check_curves(output, form)
        if len(faces) > 1:
            raise UserError("curves are of one face; give --lips once")
    else:
        if form is not CurveForm.FAPS:
            raise UserError(f"--as {form} is for curves; write .csv, .jsonl or .glb")
        check_pictures(output, shot)
        renderer = make_renderer(shot, output, faces)
    with Progress(console=CONSOLE, transient=True, disable=not CONSOLE.is_interactive) as progress:
        motion = (
            read_motion(source, sound)
            if is_fap(source)
            else motion_of_sound(
                source,
                faces,
                progress,
                live=live,
                text=text,
                mouth=mouth,
                expressiveness=expressiveness,
            )
        )
        if not motion.frames:
            raise UserError(f"{source}: it has no frames")
        if renderer is None:
            curves.write_curves(motion, output, form, head)
            made = _number(len(motion.frames), "frame")
        else:
            made = _number(draw(motion, renderer, output, shot, progress), "image")
            renderer.close()
    if motion.num_phones == 0:
        print_message(f"{source}: no speech was found; the mouth stays closed")
    phones = "" if motion.num_phones is None else f", {_number(motion.num_phones, 'phone')}"
    print_message(f"wrote {output}: {made}{phones}")


def _number(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _check_source(source: Path, *, sound: bool, **of_sounds: bool) -> None:
    """Refuse options that do not fit a source."""
    from kouxing.services.cli.motion import is_fap

    if of_sounds["live"] and of_sounds["text"]:
        raise UserError("--live knows no text beforehand; leave --live or --text out")
    if not is_fap(source):
        if sound:
            raise UserError(f"--sound is for a .fap file; {source} brings its own")
        return
    given = [name for name, is_given in of_sounds.items() if is_given]
    if given:
        raise UserError(f"--{given[0]} is for a sound; {source} holds the motion of its lips")


def phones(
    audio: Audio, acoustic: Acoustic = "blocks", form: Form = None, output: Output = None
) -> None:
    """Recognise an audio file: phones with their times."""
    from kouxing.services.cli.sound_file import read_mono_16k
    from kouxing.services.recognizer.acoustic.load import load_model, model_path
    from kouxing.services.recognizer.offline import recognize
    from kouxing.shared.clock import MEDIA_RATE_HZ
    from kouxing.shared.phones.phone_files import format_phones

    style = _form(form, output)
    samples = read_mono_16k(audio)
    duration_s = len(samples) / MEDIA_RATE_HZ
    with CONSOLE.status(f"recognising {duration_s:.0f} s"):
        found = recognize(load_model(model_path(acoustic)), samples, MEDIA_RATE_HZ)
    if not found:
        print_message(f"{audio}: no speech was found")
    write_output(format_phones(found, style, duration_s), output)


def align(
    audio: Audio,
    text: Annotated[
        str, typer.Argument(help="What is said: Chinese characters or pinyin, or a file of them.")
    ],
    acoustic: Acoustic = "blocks",
    form: Form = None,
    output: Output = None,
) -> None:
    """Find the times of the phones of a known text; status 1 if it does not fit the sound."""
    from kouxing.services.cli.sound_file import read_mono_16k
    from kouxing.services.cli.spoken_text import does_not_fit, read_text
    from kouxing.services.recognizer.acoustic.load import load_model, model_path
    from kouxing.services.recognizer.alignment import align_syllables, timed_syllables
    from kouxing.shared.clock import MEDIA_RATE_HZ
    from kouxing.shared.phones.phone_files import format_phones

    style = _form(form, output)
    samples = read_mono_16k(audio)
    model = load_model(model_path(acoustic))
    transcript = read_text(text, model.inventory)
    alignment = align_syllables(model, samples, MEDIA_RATE_HZ, transcript.phones)
    duration_s = len(samples) / MEDIA_RATE_HZ
    syllables = timed_syllables(alignment.phones, transcript, model.inventory)
    write_output(format_phones(alignment.phones, style, duration_s, syllables), output)
    if not alignment.fits:
        print_message(does_not_fit(audio, alignment))
        raise typer.Exit(1)


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
    from kouxing.services.cli.mouth_drawing import draw_mouth

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
        if form is None:
            raise UserError(f"{output}: give a name that ends in {', '.join(_FORM_OF_SUFFIX)}")
    return (form or PhoneFormat.TABLE).value
