"""The commands that need no running services: files in, files out."""

from collections.abc import Sequence
from contextlib import closing
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from kouxing.services.cli.options import (
    ACOUSTIC_MODEL,
    AudioTrack,
    CaptionKind,
    CurveFormat,
    ExportOptions,
    HeadName,
    Language,
    MouthFile,
    PhoneAlphabet,
    TimingMethod,
    WidthSource,
    reject_options,
)
from kouxing.services.cli.recordings.batch import is_folder, pair_outputs, process_all
from kouxing.services.driver.config import Framing
from kouxing.shared.command.terminal import (
    Force,
    check_output,
    open_progress,
    plural,
    print_message,
    show_loading,
    write_output,
)
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE

Audio = Annotated[Path, typer.Argument(help="Audio or video file; '-' is standard input.")]
Outputs = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        help="File to write. A name without a suffix is a folder for files named after the inputs.",
    ),
]
Acoustic = Annotated[
    str | None, typer.Option(help=f"{ACOUSTIC_MODEL}. Default: the model of the language.")
]


class PhoneFormat(StrEnum):
    """Formats for phones with their times."""

    TABLE = "table"
    CSV = "csv"
    JSON = "json"
    TEXTGRID = "textgrid"


Form = Annotated[
    PhoneFormat | None,
    typer.Option("--format", help="Output format. Default: from the output's suffix, or a table."),
]
_FORMAT_OF_SUFFIX = {
    ".txt": PhoneFormat.TABLE,
    ".csv": PhoneFormat.CSV,
    ".json": PhoneFormat.JSON,
    ".textgrid": PhoneFormat.TEXTGRID,
}
_SUFFIX_OF_FORMAT = {form: suffix for suffix, form in _FORMAT_OF_SUFFIX.items()}
_DEFAULTS = ExportOptions()


def render(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="AUDIO|CURVES [OUTPUT]",
            help="Audio or video files, or curves (.fap, .csv, .jsonl); '-' is standard input."
            " Then, for a single file, the output. Default: a video (.mp4) next to the file.",
        ),
    ],
    output: Outputs = None,
    text: Annotated[
        str | None,
        typer.Option(
            help="Spoken text for better lips, or a file that contains it; Mandarin in characters"
            " or pinyin."
        ),
    ] = None,
    language: Language = None,
    track: AudioTrack = None,
    live: Annotated[
        bool, typer.Option("--live", help="Show what a viewer of the live stream would see.")
    ] = False,
    lips: Annotated[
        list[str] | None,
        typer.Option(
            help="Lip model, such as learned or dynamic-visemes; repeat it to show several faces"
            " side by side."
        ),
    ] = None,
    mouth: MouthFile = None,
    expressiveness: Annotated[
        float | None,
        typer.Option(min=0.5, max=2, help="Size of the mouth movements; not for curves."),
    ] = None,
    head: HeadName = _DEFAULTS.head,
    size: Annotated[
        str, typer.Option(help="Size of the picture, WIDTHxHEIGHT in pixels.")
    ] = _DEFAULTS.size,
    background: Annotated[
        str,
        typer.Option(
            help="Background: studio, transparent (not for .mp4), #rrggbb, or a color name."
        ),
    ] = _DEFAULTS.background,
    camera: Annotated[
        Framing,
        typer.Option(
            help="What fills the picture: the face, the head or the mouth. side shows the head at"
            " 60 degrees."
        ),
    ] = _DEFAULTS.camera,
    rate: Annotated[
        float | None,
        typer.Option(
            min=1, max=240, help="Frames per second. Default: 25, or the rate of the curves."
        ),
    ] = None,
    captions: Annotated[
        CaptionKind | None,
        typer.Option(
            metavar="CONTENT",
            help="Captions below the face: pinyin, phones, or the characters of --text.",
        ),
    ] = None,
    speed: Annotated[
        float, typer.Option(min=0.25, max=1, help="Speed at the same pitch; 0.5 is half as fast.")
    ] = _DEFAULTS.speed,
    at: Annotated[float | None, typer.Option(help="Time of a single picture, seconds.")] = None,
    curve_format: Annotated[
        CurveFormat | None,
        typer.Option(
            "--as",
            metavar="VALUES",
            help=f"Values of a curve file: {', '.join(CurveFormat)}. Default: faps; rhubarb (drawn"
            " mouths) in .tsv, .xml and .json.",
        ),
    ] = None,
    sound: Annotated[Path | None, typer.Option(help="Audio file to add to curves.")] = None,
    force: Force = False,
) -> None:
    """Render a recording, or existing animation curves, as a video, images or curves.

    The output is a video (.mp4, .mov, .webm, or .webp without audio), a picture (.png), or numbered
    pictures (a folder, or a pattern such as face%05d.png). It can also be curves (.fap, .csv,
    .jsonl), an animated head (.glb) or drawn mouths (.tsv, .xml, .json of Rhubarb Lip Sync).
    Without an output, the command writes a video next to the input: my.mp4 for my.wav.
    The input may also be curves of the Live Link Face app. If --text does not fit the audio, the
    mouth follows the text, and the exit status is 1.
    """
    with show_loading():
        from kouxing.services.cli.recordings.exporters import existing_output, is_output

    if live and text is not None:
        raise UserError("a live stream has no text in advance; use either --live or --text")
    if captions is CaptionKind.CHARACTERS and text is None:
        raise UserError("--captions characters needs the spoken text; add --text")
    models = tuple(lips or _DEFAULTS.lips)
    if mouth is not None and "learned" not in models:
        raise UserError("--mouth applies to learned lips; add --lips learned")
    *sources, last = files
    if output is None and len(sources) == 1 and (is_output(last) or not last.exists()):
        pairs = [(sources[0], last)]
    else:
        pairs = pair_outputs(files, output, ".mp4")
    inputs = [*(source for source, _ in pairs), sound, mouth, Path(head)]
    if text is not None:
        inputs.append(Path(text))
    check_output(*(existing_output(target) for _, target in pairs), inputs=inputs, force=force)
    options = ExportOptions(
        lips=models, curve_format=curve_format, head=head, size=size, background=background,
        camera=camera, rate_hz=rate, at_s=at, sound=sound, captions=captions, speed=speed,
    )  # fmt: skip

    wrong_texts: list[Path] = []

    def render_file(source: Path, target: Path) -> None:
        from kouxing.services.cli.recordings.animation import animate, has_motion, read_motion
        from kouxing.services.cli.recordings.exporters import open_exporter

        if has_motion(source):
            reject_options(
                f"applies to audio; {source} already contains the lip motion",
                lips=lips, live=live, text=text, mouth=mouth, language=language,
                expressiveness=expressiveness, track=track, captions=captions,
            )  # fmt: skip
        elif sound is not None:
            raise UserError(f"--sound applies to curves; {source} has its own audio")
        with closing(open_exporter(target, options)) as exporter, open_progress() as progress:
            if has_motion(source):
                motion = read_motion(source, sound)
            else:
                motion = animate(
                    source, models, progress, live=live, text=text, mouth=mouth,
                    expressiveness=expressiveness, track=track, captions=captions,
                    language=language or DEFAULT_LANGUAGE,
                )  # fmt: skip
            if not motion.frames:
                raise UserError(f"{source}: the file contains no frames")
            count = exporter.export(motion, progress)
        if motion.phones == []:
            print_message(f"{source}: no speech was found; the mouth stays at rest")
        phones = "" if motion.phones is None else f", {plural(len(motion.phones), 'phone')}"
        print_message(f"wrote {target}: {plural(count, exporter.unit)}{phones}")
        if motion.is_text_mismatched:
            print_message(
                f"{target}: the mouth follows the text; without --text, it follows the audio"
            )
            wrong_texts.append(source)

    process_all(pairs, render_file)
    if wrong_texts:
        raise typer.Exit(1)


def phones(
    audio: Annotated[
        list[Path], typer.Argument(help="Audio or video files; '-' is standard input.")
    ],
    language: Language = None,
    acoustic: Acoustic = None,
    alphabet: PhoneAlphabet = None,
    phone_format: Form = None,
    output: Outputs = None,
    track: AudioTrack = None,
    force: Force = False,
) -> None:
    """Recognize the phones of audio files, with their times.

    proto/VALUES.md lists the symbols. For Mandarin, ii is the vowel of si and iii of shi.
    """
    with show_loading():
        from kouxing.services.mono_audio import read_mono_16k
        from kouxing.services.recognizer.acoustic.languages import load_model_for_language
        from kouxing.services.recognizer.offline.offline_recognition import recognize_recording
        from kouxing.shared.clock import MEDIA_RATE_HZ
        from kouxing.shared.phones.alphabets import respell
        from kouxing.shared.phones.phone_files import format_phones

    if len(audio) > 1 and output is None:
        raise UserError(f"{len(audio)} files need a folder for their phones; add -o FOLDER")
    style, pairs = _phone_outputs(audio, output, phone_format)
    check_output(*(target for _, target in pairs), inputs=audio, force=force)
    with show_loading():
        model = load_model_for_language(language, acoustic)

    def recognize_file(source: Path, target: Path | None) -> None:
        with open_progress() as progress:
            samples = read_mono_16k(source, track, progress)
            duration_s = len(samples) / MEDIA_RATE_HZ
            with_progress = partial(progress.track, description="recognizing")
            recognized = recognize_recording(model, samples, with_progress)
        if not recognized:
            print_message(f"{source}: no speech was found")
        written = [*respell(recognized, model.inventory, alphabet)]
        write_output(format_phones(written, style, duration_s), target)

    process_all(pairs, recognize_file)


def align(
    audio: Audio,
    text: Annotated[
        str,
        typer.Argument(
            help="Spoken text or a text file, in the language of --language. Mandarin: characters,"
            " pinyin or bopomofo."
        ),
    ],
    language: Language = None,
    acoustic: Acoustic = None,
    alphabet: PhoneAlphabet = None,
    phone_format: Form = None,
    output: Outputs = None,
    track: AudioTrack = None,
    force: Force = False,
) -> None:
    """Find the times of the phones of a known text.

    The exit status is 1 if the text does not fit the audio.
    """
    with show_loading():
        from kouxing.services.cli.texts.spoken_text import read_transcript, report_mismatch
        from kouxing.services.mono_audio import read_mono_16k
        from kouxing.services.recognizer.acoustic.languages import load_model_for_language
        from kouxing.services.recognizer.offline.alignment import (
            align_syllables,
            find_syllable_times,
        )
        from kouxing.shared.clock import MEDIA_RATE_HZ
        from kouxing.shared.phones.alphabets import respell
        from kouxing.shared.phones.inventory import load_inventory
        from kouxing.shared.phones.phone_files import format_phones

    style, [(_, output)] = _phone_outputs([audio], output, phone_format)
    check_output(output, inputs=[audio, Path(text)], force=force)
    with show_loading():
        model = load_model_for_language(language, acoustic)
        transcript = read_transcript(text, load_inventory(language or model.inventory.language))
    with open_progress() as progress:
        samples = read_mono_16k(audio, track, progress)
        with_progress = partial(progress.track, description="aligning")
        alignment = align_syllables(model, samples, transcript.phones, with_progress)
    duration_s = len(samples) / MEDIA_RATE_HZ
    syllables = find_syllable_times(alignment.phones, transcript, model.inventory)
    written = [*respell(alignment.phones, model.inventory, alphabet)]
    write_output(format_phones(written, style, duration_s, syllables), output)
    report_mismatch(audio, alignment)
    if not alignment.fits:
        raise typer.Exit(1)


def lips(
    audio: Audio,
    text_and_output: Annotated[
        list[str],
        typer.Argument(
            metavar="[TEXT] OUTPUT",
            help="Spoken text (Mandarin in characters or pinyin), then the file to write: .svg or"
            " .png (the mouth at every key frame), .mp4, or .csv (the contour). Without a text,"
            " phones are recognized.",
        ),
    ],
    lips: Annotated[
        WidthSource,
        typer.Option(
            metavar="MODEL",
            help=f"Lip model for the width of the mouth: {', '.join([*WidthSource][:-1])}, or"
            f" {[*WidthSource][-1]}, which keeps it constant.",
        ),
    ] = WidthSource.VISEMES,
    language: Language = None,
    timing: Annotated[
        TimingMethod | None,
        typer.Option(
            help="Timing of the text: endpoints (energy and zero crossings), or align (forced"
            " alignment). Default: endpoints, or align for long texts."
        ),
    ] = None,
    speech_to_text: Annotated[
        Path | None, typer.Option(help="Folder of a sherpa-onnx model that transcribes the text.")
    ] = None,
    track: AudioTrack = None,
    force: Force = False,
) -> None:
    """Draw the mouth in two dimensions, for cartoons, teaching and papers.

    The exit status is 1 if the text does not fit the audio.
    """
    with show_loading():
        from kouxing.services.cli.recordings.mouth_drawing import draw_mouth

    *text, output = text_and_output
    if len(text) > 1:
        raise UserError("expected one text and one output file; put a text with spaces in quotes")
    check_output(Path(output), inputs=[audio, *map(Path, text)], force=force)
    fits = draw_mouth(
        audio,
        text[0] if text else None,
        Path(output),
        lips=lips,
        timing=timing,
        speech_to_text=speech_to_text,
        track=track,
        language=language or DEFAULT_LANGUAGE,
    )
    if not fits:
        raise typer.Exit(1)


def _phone_outputs(
    audio: Sequence[Path], output: Path | None, phone_format: PhoneFormat | None
) -> tuple[PhoneFormat, list[tuple[Path, Path | None]]]:
    """Return the format, and each recording with its output, or None for standard output."""
    style = _format(phone_format, output)
    if output is None:
        return style, [(source, None) for source in audio]
    return style, [*pair_outputs(audio, output, _SUFFIX_OF_FORMAT[style])]


def _format(phone_format: PhoneFormat | None, output: Path | None) -> PhoneFormat:
    if output is None or is_folder(output):
        return phone_format or PhoneFormat.TABLE
    suffix_format = _FORMAT_OF_SUFFIX.get(output.suffix.lower())
    if suffix_format is None:
        raise UserError(
            f"{output}: unknown format; use a name that ends in {', '.join(_FORMAT_OF_SUFFIX)}"
        )
    if phone_format not in (None, suffix_format):
        raise UserError(
            f"{output}: --format {phone_format} does not fit this name; leave out the option"
        )
    return suffix_format
