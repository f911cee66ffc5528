"""Train the recognizer and align speech with its text: ``python -m training --help``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from services.recognizer.load import MODEL_PATH, load_model
from shared.errors import UserError
from shared.phone_files import format_phones
from training.align import align_text
from training.examples import SYNTHETIC_WEIGHT
from training.feature_cache import read_audio
from training.recipes import combine, train_gmm, train_neural

app = typer.Typer(help=__doc__, no_args_is_help=True, pretty_exceptions_enable=False)

Corpora = Annotated[list[Path], typer.Argument(help="corpus folders; splits train and dev")]
Output = Annotated[Path, typer.Option(help="model file to write (.npz)")]
Seed = Annotated[int, typer.Option(help="the same seed gives the same model")]
SyntheticWeight = Annotated[float, typer.Option(help="weight of synthetic against real speech")]
AnyLicence = Annotated[
    bool, typer.Option(help="also take rows whose licence forbids giving the model away")
]


@app.command()
def gmm(
    corpora: Corpora,
    output: Output,
    seed: Seed = 0,
    mixtures: Annotated[int, typer.Option(help="Gaussians in each state, a power of two")] = 16,
    synthetic_weight: SyntheticWeight = SYNTHETIC_WEIGHT,
    any_licence: AnyLicence = False,
) -> None:
    """Train the Gaussian mixture model of the paper."""
    train_gmm(
        corpora,
        output,
        seed=seed,
        num_mixtures=mixtures,
        synthetic_weight=synthetic_weight,
        shipping=not any_licence,
    )


@app.command()
def neural(
    corpora: Corpora,
    output: Output,
    aligner: Annotated[Path, typer.Option(help="a model that 'gmm' wrote")],
    seed: Seed = 0,
    epochs: Annotated[int, typer.Option(help="passes over the data")] = 8,
    synthetic_weight: SyntheticWeight = SYNTHETIC_WEIGHT,
    any_licence: AnyLicence = False,
) -> None:
    """Train the network on frames that a Gaussian mixture model has aligned."""
    train_neural(
        corpora,
        output,
        aligner=aligner,
        seed=seed,
        num_epochs=epochs,
        synthetic_weight=synthetic_weight,
        shipping=not any_licence,
    )


@app.command(name="combine")
def combine_models(
    corpora: Corpora,
    output: Output,
    part: Annotated[list[Path], typer.Option(help="model file in the same folder; give two")],
) -> None:
    """Choose on dev how much each of two models counts."""
    combine(part, output, corpora)


@app.command()
def align(
    recording: Annotated[Path, typer.Argument(help="sound file")],
    text: Annotated[str, typer.Argument(help="what is said: Chinese characters, or pinyin")],
    style: Annotated[str, typer.Option(help="table, csv, json or textgrid")] = "table",
    model: Annotated[Path, typer.Option(help="model file")] = MODEL_PATH,
) -> None:
    """Print when each unit of a text is said in a recording."""
    try:
        samples = read_audio(recording)
    except ValueError as error:
        raise UserError(str(error)) from error
    phones = align_text(load_model(model), samples, 16_000, text)
    sys.stdout.write(format_phones(phones, style, len(samples) / 16_000))


def main() -> None:
    """Run the command line; a user's mistake is one line and exit status 2."""
    try:
        app()
    except UserError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(2)


if __name__ == "__main__":
    main()
