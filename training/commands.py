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
Language = Annotated[
    Path | None,
    typer.Option(help="From `kouxing train language`, or a model whose language to use."),
]
AnyLicence = Annotated[
    bool, typer.Option("--any-licence", help="Also take rows that forbid giving the model away.")
]


@app.command()
def language(
    output: Annotated[Path, typer.Option("--output", "-o", help="File to write (.npz).")],
    corpus: Annotated[
        list[Path] | None, typer.Option("--corpus", help="Its sentences count; repeat for several.")
    ] = None,
    text: Annotated[
        list[Path] | None, typer.Option("--text", help="Chinese text, UTF-8; repeat for several.")
    ] = None,
    ngrams: Annotated[
        Path | None, typer.Option(help="Output of `tslminfo -v`: words are drawn from it.")
    ] = None,
    dictionary: Annotated[
        Path | None, typer.Option(help="SunPinyin's pydict_sc.bin, the words of the n-grams.")
    ] = None,
    words: Annotated[int, typer.Option(min=1, help="Words to draw.")] = 30_000_000,
    order: Annotated[int, typer.Option(min=2, max=10, help="Units in the longest n-grams.")] = 6,
    most: Annotated[int, typer.Option(min=1000, help="N-grams to keep, about.")] = 1_000_000,
    seed: Seed = 0,
) -> None:
    """Count what follows what in texts, for the recognizers' search."""
    from training.open_gram import drawn_units
    from training.unit_language import train_language

    check_output(output)
    if (ngrams is None) != (dictionary is None):
        raise UserError("--ngrams and --dictionary belong together; give both or neither")
    drawn = None
    if ngrams and dictionary:
        drawn = drawn_units(ngrams, dictionary, num_words=words, seed=seed)
    train_language(corpus or [], text or [], output, drawn=drawn, order=order, most=most)


@app.command()
def gmm(
    corpus: Corpora,
    output: Model,
    language: Language = None,
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
        language=language,
        seed=seed,
        num_mixtures=mixtures,
        synthetic_weight=synthetic_weight,
        shipping=not any_licence,
    )


@app.command()
def neural(
    corpus: Corpora,
    output: Model,
    aligner: Annotated[
        Path | None,
        typer.Option(help="A model that aligns at first; without it the one of --start-from does."),
    ] = None,
    whisper: Annotated[
        Path | None,
        typer.Option(
            help="Folder of Whisper base for faster-whisper: it teaches the network, which begins "
            "with its weights."
        ),
    ] = None,
    start_from: Annotated[
        Path | None,
        typer.Option(help="Begin with a neural model's network; without --whisper nobody teaches."),
    ] = None,
    untranscribed: Annotated[
        list[Path] | None,
        typer.Option(
            help="Folder of recordings without text, in any language, of which --whisper says what "
            "is heard; repeat for several."
        ),
    ] = None,
    language: Language = None,
    seed: Seed = 0,
    look_ahead_ms: Annotated[
        float, typer.Option(help="The look-ahead to train for, in steps of 10 ms.")
    ] = 10.0,
    steps: Annotated[int, typer.Option(min=1, help="Batches of 30 s of sound.")] = 800,
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
        whisper=whisper,
        start=start_from,
        untranscribed=untranscribed or [],
        language=language,
        look_ahead_ms=look_ahead_ms,
        seed=seed,
        num_steps=steps,
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
