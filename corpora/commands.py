"""The commands ``kouxing track`` and ``kouxing adapt``: a speaker's own mouth."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from kouxing.shared.terminal import CONSOLE, JsonFile, check_output, print_message, write_json

track_app = typer.Typer(add_completion=False)
adapt_app = typer.Typer(add_completion=False)


@adapt_app.command()
def adapt(
    sources: Annotated[
        list[Path],
        typer.Argument(help="Clips (.json) and landmark files (.landmarks) of one speaker."),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Voice to write.")],
    json_file: JsonFile = None,
) -> None:
    """Learn a speaker's own mouth from tracked lips; --voice uses it."""
    from kouxing.corpora import voices
    from kouxing.services.recognizer.lip_tracks import MEASURES

    check_output(output, json_file)
    voice = voices.adapt(sources)
    output.write_bytes(voice.profile)
    table = Table("correlation with the tracked lips", "without the voice", "with it")
    for measure, *figures in zip(MEASURES, voice.gain.before, voice.gain.after, strict=True):
        table.add_row(measure, *("-" if math.isnan(each) else f"{each:.2f}" for each in figures))
    Console().print(table)
    write_json(json_file, voice.figures())
    print_message(
        f"wrote {output}, learnt from {voice.speech_s:.0f} s of speech; the table is of the last "
        f"{voice.gain.speech_s:.0f} s, after learning from the rest alone"
    )


@track_app.command()
def track(
    video: Annotated[Path, typer.Argument(help="Video of somebody who speaks, face to camera.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Clip to write: .flac, .csv and .json.")
    ],
) -> None:
    """Track the lips in a video: a clip for kouxing adapt."""
    from kouxing.corpora.lip_tracking import track_video

    check_output(*(output.with_suffix(suffix) for suffix in (".flac", ".csv", ".json")))
    with CONSOLE.status(f"tracking {video}"):
        num_seen, num_pictures = track_video(video, output)
    print_message(f"wrote {output.with_suffix('.json')}: a face in {num_seen} of {num_pictures}")
