"""The commands under ``kouxing evaluate``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from shared.errors import UserError

app = typer.Typer(no_args_is_help=True, help="Measure the models.")

JsonFile = Annotated[Path | None, typer.Option("--json", help="Also write the figures here.")]


@app.command()
def recognizer(
    manifest: Annotated[Path, typer.Option(help="Manifest or corpus folder.")],
    split: Annotated[str, typer.Option(help="Its split.")] = "test",
    acoustic: Annotated[
        list[str] | None, typer.Option(help="gmm, neural, combined or a model file; repeatable.")
    ] = None,
    confusions: Annotated[
        Path | None, typer.Option(help="Picture of the last model's confusions (.png).")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Measure phone and viseme errors, delays and cost of acoustic models, side by side."""
    from evaluation.recognizer import evaluate_recognizer, print_scores
    from services.recognizer.load import DEFAULT_MODEL, load_model, model_path

    console = Console()
    results = {}
    for name in acoustic or [DEFAULT_MODEL]:
        figures = evaluate_recognizer(
            load_model(model_path(name)), manifest, split, confusion_picture=confusions
        )
        results[name] = figures
        console.rule(name)
        print_scores(figures, console)
    _write(json_file, results)


@app.command()
def lips(
    clips: Annotated[Path, typer.Option(help="Folder of tracked lips with sound.")],
    parameters: Annotated[Path | None, typer.Option(help="Viseme parameters (.json).")] = None,
    json_file: JsonFile = None,
) -> None:
    """Compare modelled lips with tracked ones, for every scheme and look-ahead."""
    from evaluation.lips import main

    main(clips, json_file, parameters)


def _write(path: Path | None, figures: object) -> None:
    if path is None:
        return
    try:
        path.write_text(json.dumps(figures, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None
