"""The commands ``kouxing track`` and ``kouxing adapt``: learn a speaker's own mouth."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kouxing.services.cli.options import AudioTrack, Panel
from kouxing.shared.command.terminal import (
    CONSOLE,
    Force,
    JsonFile,
    check_output,
    print_message,
    print_table,
    write_json,
)
from kouxing.shared.errors import UserError
from kouxing.shared.files.output_file import open_output

if TYPE_CHECKING:
    from kouxing.services.mouth_profiles.learning import FilmedSpeech

track_app = typer.Typer(add_completion=False)
adapt_app = typer.Typer(add_completion=False)


@adapt_app.command(rich_help_panel=Panel.RECORDINGS)
def adapt(
    sources: Annotated[
        list[Path],
        typer.Argument(help="Clips (.json) and landmark files (.landmarks) of one speaker."),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Mouth profile to write.")],
    json_file: JsonFile = None,
    force: Force = False,
) -> None:
    """Learn a speaker's mouth profile from tracked lips, for the option --mouth."""
    from kouxing.services.mouth_profiles.learning import learn_mouth_profile
    from kouxing.services.mouth_profiles.lip_tracks import MEASURES

    for source, count in Counter(source.resolve() for source in sources).items():
        if count > 1:  # the figures need speech that the profile was not learned from
            raise UserError(f"{source} is named twice")
    check_output(output, json_file, inputs=sources, force=force)
    learned = learn_mouth_profile([_read(source) for source in sources])
    with open_output(output) as file:
        file.write(learned.content)
    columns = ("correlation with the tracked lips", "without the profile", "with it")
    rows = [
        (measure, *("-" if math.isnan(figure) else f"{figure:.2f}" for figure in figures))
        for measure, *figures in zip(MEASURES, learned.gain.before, learned.gain.after, strict=True)
    ]
    print_table(columns, rows)
    write_json(json_file, learned.figures())
    print_message(
        f"wrote {output}, learned from {learned.speech_s:.0f} s of speech; the table compares the "
        f"last {learned.gain.speech_s:.0f} s, with a profile learned from the rest only"
    )


def _read(source: Path) -> FilmedSpeech:
    from kouxing.corpora.lip_clips import read_clip
    from kouxing.services.mouth_profiles.landmark_file import MAX_BYTES, SUFFIX, parse_landmark_file
    from kouxing.shared.files.user_file import read_file

    if source.suffix != SUFFIX:
        return read_clip(source).filmed_speech()
    content = read_file(source, MAX_BYTES)
    try:
        return parse_landmark_file(content)
    except UserError as error:
        raise UserError(f"{source}: {error}") from error


@track_app.command(rich_help_panel=Panel.RECORDINGS)
def track(
    video: Annotated[Path, typer.Argument(help="Video of a speaker who faces the camera.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Clip to write: .flac, .csv and .json.")
    ],
    audio_track: AudioTrack = None,
    force: Force = False,
) -> None:
    """Track the lips in a video, for kouxing adapt."""
    from kouxing.corpora.lip_tracking import track_video

    outputs = [output.with_suffix(suffix) for suffix in (".flac", ".csv", ".json")]
    check_output(*outputs, inputs=[video], force=force)
    with CONSOLE.status(f"tracking {video}"):
        num_tracked, num_images = track_video(video, output, audio_track)
    print_message(
        f"wrote {output.with_suffix('.json')}; a face was found in {num_tracked} of "
        f"{num_images} images"
    )
