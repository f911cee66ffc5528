"""The commands under ``kouxing train``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from services.terminal import check_output
from shared.errors import UserError
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
    mixtures: Annotated[int, typer.Option(help="Gaussians a state, a power of two.")] = 32,
    synthetic_weight: SyntheticWeight = SYNTHETIC_WEIGHT,
    any_licence: AnyLicence = False,
) -> None:
    """Train the Gaussian mixture model of the paper; a model card is written beside it."""
    from training.recipes import train_gmm

    check_output(output)
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
    aligner: Annotated[Path, typer.Option(help="A model file that aligns the first time.")],
    second_task: Annotated[
        Path | None, typer.Option(help="Folder of speech in another language, with its phones.")
    ] = None,
    seed: Seed = 0,
    look_ahead_ms: Annotated[
        float, typer.Option(help="The look-ahead to train for, in steps of 10 ms.")
    ] = 10.0,
    steps: Annotated[int, typer.Option(help="Batches of 50 s of sound.")] = 4000,
    networks: Annotated[
        int, typer.Option(help="How many learn, a core each; their mean counts.")
    ] = 2,
    voices: Annotated[int, typer.Option(help="Other voices for each real sentence.")] = 6,
    any_licence: AnyLicence = False,
) -> None:
    """Train the neural model; a model card and the training curves are written beside it."""
    check_output(output)
    try:
        from training.neural_recipe import train_neural
    except ModuleNotFoundError as error:
        raise UserError(
            f"{error.name} is missing; install it: pip install 'kouxing[neural-training]'"
        ) from error

    train_neural(
        corpus,
        output,
        aligner=aligner,
        second_task=second_task,
        look_ahead_ms=look_ahead_ms,
        seed=seed,
        num_steps=steps,
        num_networks=networks,
        num_voices=voices,
        shipping=not any_licence,
    )


@app.command()
def visemes(
    lips: Annotated[Path, typer.Option("--clips", help="Folder of tracked lips with sound.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Parameter file (.json).")],
    any_licence: AnyLicence = False,
) -> None:
    """Learn the dynamic visemes' parameters from tracked lips."""
    from training.visemes import train

    check_output(output)
    train(lips, output, any_licence=any_licence)
