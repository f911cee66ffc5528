"""The commands that need no running services: files in, files out."""

from __future__ import annotations

from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress

from services.terminal import CONSOLE, JsonFile, say, show, write_json
from shared.config import DriverConfig
from shared.errors import UserError

head_app = typer.Typer(no_args_is_help=True, help="The 3-D heads.")

Acoustic = Annotated[str, typer.Option(help="Model: neural, gmm, or a file.")]
HeadName = Annotated[
    str, typer.Option("--head", help="woman, man, elder, child, an .npz, or a .glb with morphs.")
]
DEFAULT_HEAD = DriverConfig().head


class PhoneFormat(StrEnum):
    """How phones are written."""

    TABLE = "table"
    CSV = "csv"
    JSON = "json"
    TEXTGRID = "textgrid"


class CameraName(StrEnum):
    """What fills the picture, as ``services.driver.scene.Framing``."""

    FACE = "face"
    HEAD = "head"
    MOUTH = "mouth"


Form = Annotated[
    PhoneFormat | None,
    typer.Option(
        "--format", help="Form; if it is not said, the file's suffix tells, else a table."
    ),
]
_FORMS = {f".{form.value}": form for form in PhoneFormat}


def add_to(app: typer.Typer) -> None:
    """Add the commands to the program's own."""
    for command in (render, phones, align, bench):
        app.command()(command)


def render(
    source: Annotated[Path, typer.Argument(metavar="SOUND|FAP", help="Audio or .fap file.")],
    output: Annotated[
        Path,
        typer.Argument(
            help="Video (.mp4, .mov, .webm), one picture (.png), or a picture for every image (a"
            " folder, or a name with a number: face%05d.png)."
        ),
    ],
    head: HeadName = DEFAULT_HEAD,
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT in pixels.")] = "1280x720",
    background: Annotated[
        str, typer.Option(help="studio, transparent (not .mp4), #rrggbb, or a colour's name.")
    ] = "studio",
    camera: Annotated[CameraName, typer.Option(help="What fills the picture.")] = CameraName.FACE,
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
) -> None:
    """Make a video or pictures of an audio or FAP file; no services need to be running."""
    from services.driver import film, scene
    from services.driver.render import Renderer
    from services.driver.video import VIDEO_SUFFIXES, check_name, is_sequence
    from shared.fap_file import read_fap

    is_picture = output.suffix == ".png" and not is_sequence(output)
    is_face = source.suffix.lower() == ".fap"
    width_px, height_px = _size(size, even=output.suffix in VIDEO_SUFFIXES)
    if at is not None and not is_picture:
        raise UserError("--at says when one picture is taken; give the name of one (.png)")
    if sound is not None and not is_face:
        raise UserError(f"--sound is for a .fap file; {source} brings its own")
    if not is_picture:
        check_name(output)
    colours = scene.background(background)
    if colours is None and output.suffix == ".mp4":
        raise UserError("MP4 has no transparency; write .mov, .webm, or pictures (.png)")
    whose = scene.load_head(head)

    with Progress(console=CONSOLE, transient=True) as progress:
        num_phones = None
        if is_face:
            animation = read_fap(source)
            frames = film.frames_of(animation)
            rate = rate or min(animation.frame_rate_hz, 240.0)
            samples = None if sound is None else _mono_16k(sound)
        else:
            from services import offline

            samples = _mono_16k(source)
            hearing = progress.add_task("recognising", total=1.0)
            heard, frames = offline.live_frames(
                samples, on_progress=lambda share: progress.update(hearing, completed=share)
            )
            num_phones = len({phone.index for phone in heard})
        if not frames:
            raise UserError(f"{source}: it has no frames")
        renderer = Renderer(
            whose,
            width_px,
            height_px,
            background=colours,
            camera=scene.camera(whose, scene.Framing(camera.value), yaw, pitch),
        )
        if is_picture:
            film.render_picture(frames, output, renderer, at or 0.0)
            num_images = 1
        else:
            drawing = progress.add_task("drawing", total=1.0)
            num_images = film.render_video(
                frames,
                output,
                renderer,
                frame_rate_hz=rate or 25.0,
                samples=samples,
                on_progress=lambda share: progress.update(drawing, completed=share),
            )
        renderer.close()
    if num_phones == 0:
        say(f"{source}: no speech was heard; the mouth stays closed")
    said = "" if num_phones is None else f", {num_phones} phones"
    say(f"wrote {output}: {num_images} {'image' if num_images == 1 else 'images'}{said}")


def phones(
    audio: Annotated[Path, typer.Argument(help="Audio file.")],
    acoustic: Acoustic = "neural",
    form: Form = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="File to write.")] = None,
) -> None:
    """Recognise an audio file: units with their times."""
    from services import offline
    from services.recognizer.load import load_model, model_path
    from services.recognizer.pipeline import recognize
    from shared.messages import MEDIA_RATE_HZ
    from shared.phone_files import format_phones

    samples = offline.mono_16k(audio)
    with CONSOLE.status(f"recognising {len(samples) / MEDIA_RATE_HZ:.0f} s"):
        found = recognize(load_model(model_path(acoustic)), samples, MEDIA_RATE_HZ)
    if not found:
        say(f"{audio}: no speech was heard")
    show(format_phones(found, _form(form, output), len(samples) / MEDIA_RATE_HZ), output)


def align(
    audio: Annotated[Path, typer.Argument(help="Audio file.")],
    text: Annotated[str, typer.Argument(help="What is said: Chinese characters, or pinyin.")],
    acoustic: Acoustic = "neural",
    form: Form = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="File to write.")] = None,
) -> None:
    """Find when each unit of a known text is said."""
    from services import offline
    from services.recognizer.load import load_model, model_path
    from shared.messages import MEDIA_RATE_HZ
    from shared.phone_files import format_phones
    from training.align import align_text

    samples = offline.mono_16k(audio)
    said = align_text(load_model(model_path(acoustic)), samples, MEDIA_RATE_HZ, text)
    show(format_phones(said, _form(form, output), len(samples) / MEDIA_RATE_HZ), output)


def bench(
    audio: Annotated[Path, typer.Argument(help="Audio file to stream.")],
    repeats: Annotated[int, typer.Option(min=1, help="How often to stream it.")] = 3,
    json_file: JsonFile = None,
) -> None:
    """Measure latency, CPU and images per second of the whole chain on this machine."""
    from evaluation import latency, rendering

    delays = latency.measure(audio, repeats, CONSOLE)
    pictures = rendering.measure()
    out = Console()
    latency.show(delays, out)
    rendering.show(pictures, out)
    write_json(json_file, asdict(delays) | {"rendering": asdict(pictures)})


@head_app.command("export")
def head_export(
    glb: Annotated[Path, typer.Argument(help="File to write (.glb).")],
    head: HeadName = DEFAULT_HEAD,
) -> None:
    """Write a head as a GLB with a morph target for every FAP."""
    from services.driver.glb import export_glb
    from services.driver.scene import load_head

    export_glb(load_head(head), glb)
    say(f"wrote {glb} ({glb.stat().st_size / 1e6:.1f} MB)")


@head_app.command("import")
def head_import(
    mesh: Annotated[Path, typer.Argument(help="Mesh of a head at rest (.obj, .glb, .ply).")],
    points: Annotated[
        Path,
        typer.Option(
            help="MPEG-4 feature points: lines 'point x y z' or 'point vertex' (from 0), or an"
            " XfaceEd .fdp file."
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Head to write (.npz).")],
) -> None:
    """Make a head that FAPs move out of a mesh; use it by --head."""
    from services.driver.import_head import import_head

    remarks = import_head(mesh, points, output)
    for remark in remarks:
        say(remark)
    say(f"wrote {output} ({output.stat().st_size / 1e6:.1f} MB)")


def _form(form: PhoneFormat | None, output: Path | None) -> str:
    if form is None and output is not None:
        form = _FORMS.get(output.suffix.lower())
    return (form or PhoneFormat.TABLE).value


def _mono_16k(path: Path) -> NDArray[np.float32]:
    from services import offline

    return offline.mono_16k(path)


def _size(text: str, *, even: bool) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise UserError(f"--size {text}: write WIDTHxHEIGHT, for example 1280x720")
    width_px, height_px = int(width), int(height)
    if not (16 <= width_px <= 7680 and 16 <= height_px <= 4320):
        raise UserError(f"--size {text}: 16x16 to 7680x4320")
    if even and (width_px % 2 or height_px % 2):
        raise UserError(f"--size {text}: both must be even for a video")
    return width_px, height_px
