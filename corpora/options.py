"""Options of the commands that train and measure models."""

from pathlib import Path
from typing import Annotated

import typer

_CLIPS = typer.Option(help="Folder of clips with tracked lips.")
_SOUNDS = typer.Option(help="Folder of music, noise, singing and laughter; repeatable.")

Clips = Annotated[Path, _CLIPS]
OptionalClips = Annotated[Path | None, _CLIPS]
Sounds = Annotated[list[Path], _SOUNDS]
OptionalSounds = Annotated[list[Path] | None, _SOUNDS]
EmotionalSpeech = Annotated[
    Path, typer.Option("--recordings", help="Folder of speech whose manifest names emotions.")
]
Picture = Annotated[Path | None, typer.Option(help="Picture file (.png) to write.")]
