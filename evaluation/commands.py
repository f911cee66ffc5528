"""The commands under ``kouxing evaluate``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from services.terminal import JsonFile, check_output, say, write_json

app = typer.Typer(no_args_is_help=True, help="Measure the models.")
plot_app = typer.Typer(no_args_is_help=True, help="Draw pictures of the models.")

SENTENCE = Path(__file__).parents[1] / "shared" / "demo" / "hello-female.wav"


@app.command()
def recognizer(
    manifest: Annotated[Path, typer.Option(help="Manifest or corpus folder.")],
    split: Annotated[str, typer.Option(help="Its split.")] = "test",
    acoustic: Annotated[
        list[str] | None, typer.Option(help="neural, gmm or a model file; repeatable.")
    ] = None,
    look_ahead: Annotated[
        list[float] | None,
        typer.Option("--look-ahead-ms", help="Of the neural model, such as 60; repeatable."),
    ] = None,
    confusions: Annotated[
        Path | None, typer.Option(help="Picture of the last model's confusions (.png).")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Measure phone and viseme errors, delays and cost of acoustic models, side by side."""
    from evaluation.recognizer import evaluate_recognizer
    from evaluation.recognizer_report import draw_confusions, print_figures
    from services.recognizer.load import DEFAULT_MODEL, load_model, model_path

    check_output(confusions, json_file)
    results = {}
    for name in acoustic or [DEFAULT_MODEL]:
        for look_ahead_ms in look_ahead or (None,):
            model = load_model(model_path(name), look_ahead_ms=look_ahead_ms)
            title = name if look_ahead_ms is None else f"{name}, {look_ahead_ms:g} ms look-ahead"
            results[title] = evaluate_recognizer(model, manifest, split)
    print_figures(results, Console())
    write_json(json_file, results)
    if confusions is not None:
        draw_confusions(list(results.values())[-1], confusions)


@app.command()
def robustness(
    manifest: Annotated[Path, typer.Option(help="Manifest or corpus folder.")],
    split: Annotated[str, typer.Option(help="Its split.")] = "test",
    acoustic: Annotated[
        list[str] | None, typer.Option(help="neural, gmm or a model file; repeatable.")
    ] = None,
    other_language: Annotated[
        Path | None, typer.Option(help="Folder of recordings in another language.")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Measure errors in noise, on the telephone, too fast..., and what is heard in no speech."""
    from evaluation.robustness import evaluate_robustness, print_robustness
    from services.recognizer.load import DEFAULT_MODEL, load_model, model_path

    check_output(json_file)
    models = {name: load_model(model_path(name)) for name in acoustic or [DEFAULT_MODEL]}
    results = {
        name: evaluate_robustness(model, manifest, split, other_language=other_language)
        for name, model in models.items()
    }
    print_robustness(results, Console())
    write_json(json_file, results)


@app.command()
def lips(
    clips: Annotated[Path, typer.Option(help="Folder of tracked lips with sound.")],
    parameters: Annotated[Path | None, typer.Option(help="Viseme parameters (.json).")] = None,
    json_file: JsonFile = None,
) -> None:
    """Compare modelled lips with tracked ones, for every scheme and look-ahead.

    Only clips count that the parameters were neither learnt from nor chosen with.
    """
    from evaluation.lips import main

    check_output(json_file)
    write_json(json_file, [asdict(score) for score in main(clips, parameters)])


@app.command()
def visemes(
    clips: Annotated[Path, typer.Option(help="Folder of tracked lips with sound.")],
    parameters: Annotated[Path | None, typer.Option(help="Viseme parameters (.json).")] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Picture of measured and modelled curves (.png).")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Show how well the visemes fit lips they were not learnt from, and what learning changed."""
    from evaluation.viseme_fit import main

    check_output(picture, json_file)
    write_json(json_file, main(clips, parameters, picture))


@plot_app.command(name="visemes")
def plot_visemes(
    folder: Annotated[Path, typer.Argument(help="Folder for the pictures.")] = Path("out/visemes"),
    audio: Annotated[Path, typer.Option(help="The sentence to draw.")] = SENTENCE,
    parameters: Annotated[Path | None, typer.Option(help="Viseme parameters (.json).")] = None,
) -> None:
    """Draw the visemes' faces, their dominance curves, and the FAP curves of a sentence."""
    from evaluation.viseme_plots import plot_visemes as draw

    for path in draw(folder, audio, parameters):
        say(f"wrote {path}")
