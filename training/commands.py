"""The commands under ``kouxing train``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from training import SYNTHETIC_WEIGHT

app = typer.Typer(no_args_is_help=True, help="Train the models.")

Corpora = Annotated[
    list[Path],
    typer.Option("--corpus", help="Corpus folder or manifest; repeat for several."),
]
Model = Annotated[Path, typer.Option("--output", "-o", help="Model file to write (.npz).")]
Seed = Annotated[int, typer.Option(help="The same seed gives the same model.")]
SyntheticWeight = Annotated[float, typer.Option(help="Of synthetic against real speech.")]
AnyLicence = Annotated[
    bool, typer.Option("--any-licence", help="Also take rows that forbid giving the model away.")
]


@app.command()
def gmm(
    corpus: Corpora,
    output: Model,
    seed: Seed = 0,
    mixtures: Annotated[int, typer.Option(help="Gaussians a state, a power of two.")] = 16,
    synthetic_weight: SyntheticWeight = SYNTHETIC_WEIGHT,
    any_licence: AnyLicence = False,
) -> None:
    """Train the Gaussian mixture model of the paper; a model card is written beside it."""
    from training.recipes import train_gmm

    train_gmm(
        corpus,
        output,
        seed=seed,
        num_mixtures=mixtures,
        synthetic_weight=synthetic_weight,
        shipping=not any_licence,
    )


@app.command()
def neural(
    corpus: Corpora,
    output: Model,
    aligner: Annotated[Path, typer.Option(help="A model that 'gmm' wrote.")],
    seed: Seed = 0,
    epochs: Annotated[int, typer.Option(help="Passes over the data.")] = 8,
    synthetic_weight: SyntheticWeight = SYNTHETIC_WEIGHT,
    any_licence: AnyLicence = False,
) -> None:
    """Train the network on frames that a Gaussian mixture model has aligned."""
    from training.recipes import train_neural

    train_neural(
        corpus,
        output,
        aligner=aligner,
        seed=seed,
        num_epochs=epochs,
        synthetic_weight=synthetic_weight,
        shipping=not any_licence,
    )


@app.command(name="combine")
def combine_models(
    corpus: Corpora,
    output: Model,
    part: Annotated[list[Path], typer.Option(help="Model in the same folder; give two.")],
) -> None:
    """Choose on dev how much each of two models counts."""
    from training.recipes import combine

    combine(part, output, corpus)


@app.command()
def visemes(
    lips: Annotated[Path, typer.Option("--clips", help="Folder of tracked lips with sound.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Parameter file (.json).")],
) -> None:
    """Learn the dynamic visemes' parameters from tracked lips."""
    from training.visemes import train

    train(lips, output)
