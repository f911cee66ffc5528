"""The commands under ``kouxing train``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

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
    synthetic_weight: SyntheticWeight = 1.0,
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
def visemes(
    lips: Annotated[Path, typer.Option("--clips", help="Folder of tracked lips with sound.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Parameter file (.json).")],
) -> None:
    """Learn the dynamic visemes' parameters from tracked lips."""
    from training.visemes import train

    train(lips, output)
