"""The commands under ``kouxing train``."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from kouxing.shared.errors import UserError, install_command
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE, load_inventory
from kouxing.shared.terminal import Force, check_output

app = typer.Typer(no_args_is_help=True, add_completion=False, help="Train the models.")

Corpora = Annotated[
    list[Path], typer.Option("--corpus", help="Corpus folder or manifest; repeatable.")
]
Clips = Annotated[Path, typer.Option(help="Folder of clips with tracked lips.")]
Model = Annotated[Path, typer.Option("--output", "-o", help="Model file to write (.npz).")]
Language = Annotated[str, typer.Option(help="Language of the corpora and texts.")]
PhoneLm = Annotated[
    Path | None,
    typer.Option(help="Phone language model: phone_lm.npz, or the file of an acoustic model."),
]
AnyLicense = Annotated[
    bool, typer.Option("--any-license", help="Also use data whose license forbids distribution.")
]
Whisper = Annotated[
    Path, typer.Option(help="Folder of Whisper base for faster-whisper, for its encoder.")
]
StartFrom = Annotated[
    Path | None,
    typer.Option(
        help="Acoustic model that aligns the recordings and provides the phone language model. "
        "Default: the shipped block model."
    ),
]
Untranscribed = Annotated[
    list[Path] | None,
    typer.Option(
        help="Folder of recordings in any language, for the teacher to label; repeatable."
    ),
]
Sounds = Annotated[
    list[Path], typer.Option(help="Folder of music, noise and laughter; repeatable.")
]


@contextmanager
def _neural_training(output: Path | None = None, *, force: bool = False) -> Iterator[None]:
    """Check the output, and explain how to install a missing package."""
    check_output(output, force=force)
    try:
        yield
    except ModuleNotFoundError as error:
        raise UserError(
            f"{error.name} is missing: {install_command('kouxing[neural-training]')}"
        ) from error


@app.command()
def phone_lm(
    output: Annotated[Path, typer.Option("--output", "-o", help="File to write (.npz).")],
    corpus: Annotated[
        list[Path] | None,
        typer.Option("--corpus", help="Corpus whose sentences are counted; repeatable."),
    ] = None,
    text: Annotated[
        list[Path] | None, typer.Option("--text", help="Text file, UTF-8; repeatable.")
    ] = None,
    ngrams: Annotated[
        Path | None, typer.Option(help="Output of `tslminfo -v`, to sample words from.")
    ] = None,
    dictionary: Annotated[
        Path | None, typer.Option(help="SunPinyin's pydict_sc.bin, with the words of --ngrams.")
    ] = None,
    language: Language = DEFAULT_LANGUAGE,
    force: Force = False,
) -> None:
    """Train a phone language model on texts."""
    from kouxing.training.phone_lm.open_gram import draw_phones
    from kouxing.training.phone_lm.recipe import train_phone_lm

    inputs = [*(corpus or []), *(text or []), ngrams, dictionary]
    check_output(output, inputs=inputs, force=force)
    if (ngrams is None) != (dictionary is None):
        raise UserError("use --ngrams and --dictionary together")
    inventory = load_inventory(language)
    drawn = None
    if ngrams and dictionary:
        drawn = draw_phones(ngrams, dictionary, inventory)
    train_phone_lm(corpus or [], text or [], output, inventory, drawn=drawn)


@app.command()
def gmm(
    corpus: Corpora,
    output: Model,
    phone_lm: PhoneLm = None,
    language: Language = DEFAULT_LANGUAGE,
    any_license: AnyLicense = False,
    force: Force = False,
) -> None:
    """Train the Gaussian mixture recognizer, and write its model card."""
    from kouxing.training.gmm.recipe import train_gmm

    check_output(output, inputs=[*corpus, phone_lm], force=force)
    train_gmm(
        corpus,
        output,
        load_inventory(language),
        phone_lm=phone_lm,
        shipping=not any_license,
    )


@app.command()
def blocks(
    corpus: Corpora,
    output: Model,
    whisper: Whisper,
    start_from: StartFrom = None,
    untranscribed: Untranscribed = None,
    sounds: Annotated[
        list[Path] | None,
        typer.Option(help="Folder of music and noise for the background; repeatable."),
    ] = None,
    steps: Annotated[
        int, typer.Option(min=1, help="Number of steps, each with 256 s of audio.")
    ] = 1000,
    any_license: AnyLicense = False,
    force: Force = False,
) -> None:
    """Train the block model, and write its model card.

    Repeat the command to resume an interrupted run. The number of steps may change.
    """
    with _neural_training(output, force=force):
        from kouxing.training.blocks.recipe import train_blocks

    train_blocks(
        corpus,
        output,
        whisper=whisper,
        start=start_from,
        untranscribed=untranscribed or [],
        sounds=sounds or [],
        num_steps=steps,
        shipping=not any_license,
    )


@app.command()
def universal(
    corpus: Corpora,
    output: Model,
    learners: Annotated[
        list[Path] | None,
        typer.Option(help="Corpus of English by native speakers of Mandarin; repeatable."),
    ] = None,
    languages: Annotated[
        list[Path] | None,
        typer.Option(help="Corpus with a column of languages; repeatable."),
    ] = None,
    clips: Annotated[Path | None, typer.Option(help="Folder of clips of GRID.")] = None,
    steps: Annotated[
        int, typer.Option(min=1, help="Number of steps, each with 19 s of audio.")
    ] = 2000,
    force: Force = False,
) -> None:
    """Train the universal phones, a readout of the shipped block model, and write its model card.

    Give Mandarin corpora with --corpus. Repeat the command to resume an interrupted run.
    """
    with _neural_training(output, force=force):
        from kouxing.training.universal.recipe import train_universal

    train_universal(
        corpus,
        output,
        learners=learners or [],
        languages=languages or [],
        clips=clips,
        num_steps=steps,
    )


@app.command()
def encoder(
    corpus: Corpora,
    output: Model,
    whisper: Whisper,
    sounds: Sounds,
    clips: Clips,
    untranscribed: Untranscribed = None,
    steps: Annotated[
        int, typer.Option(min=1, help="Number of batches, each with 140 s of audio.")
    ] = 7000,
    any_license: AnyLicense = False,
    force: Force = False,
) -> None:
    """Train the audio encoder, a network for lips and voice, and write its model card.

    Repeat the command to resume an interrupted run.
    """
    with _neural_training(output, force=force):
        from kouxing.training.encoder.recipe import train_encoder

    train_encoder(
        corpus,
        output,
        whisper=whisper,
        clips=clips,
        untranscribed=untranscribed or [],
        sounds=sounds,
        num_steps=steps,
        shipping=not any_license,
    )


@app.command()
def visemes(
    clips: Clips,
    output: Annotated[Path, typer.Option("--output", "-o", help="Parameter file (.json).")],
    any_license: AnyLicense = False,
    force: Force = False,
) -> None:
    """Train the parameters of the dynamic visemes on tracked lips."""
    from kouxing.training.visemes.recipe import train_visemes

    check_output(output, force=force)
    train_visemes(clips, output, any_license=any_license)


@app.command()
def lips(
    clips: Clips,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Model file to write (.npz).")
    ] = Path("services/recognizer/models/lips.npz"),
    any_license: AnyLicense = False,
    force: Force = False,
) -> None:
    """Train the lip model on tracked lips, and write its model card."""
    with _neural_training(output, force=force):
        from kouxing.training.lips.recipe import train_lips

    train_lips(clips, output, any_license=any_license)


@app.command()
def ferguson(
    clips: Clips,
    corpus: Corpora,
    output: Annotated[Path, typer.Option("--output", "-o", help="Table to write (.tsv).")],
    any_license: AnyLicense = False,
    force: Force = False,
) -> None:
    """Train the table of the ferguson lip model: openings, durations and influence factors."""
    from kouxing.training.ferguson.recipe import train_ferguson

    check_output(output, force=force)
    train_ferguson(clips, corpus, output, any_license=any_license)


@app.command()
def traits(
    recordings: Annotated[
        Path, typer.Option(help="Folder of speech whose manifest names emotions.")
    ],
    sounds: Sounds,
    output: Model,
    any_license: AnyLicense = False,
    force: Force = False,
) -> None:
    """Train the readout of arousal, valence, laughter and breath, and write its model card."""
    from kouxing.training.traits import train_traits

    check_output(output, force=force)
    train_traits(recordings, sounds, output, shipping=not any_license)


@app.command()
def heads(
    parts: Annotated[
        Path, typer.Option(help="Folder with MakeHuman's hair, brows, lashes, eyes and skins.")
    ],
    names: Annotated[list[str] | None, typer.Argument(help="Heads to build. Default: all.")] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the heads.")] = Path(
        "services/driver/head/assets"
    ),
    force: Force = False,
) -> None:
    """Build the built-in heads from MakeHuman data."""
    from kouxing.training.heads.people import PEOPLE
    from kouxing.training.heads.recipe import build_heads

    if unknown := sorted({*(names or [])} - {*PEOPLE}):
        raise UserError(f"unknown heads: {', '.join(unknown)}; choose from {', '.join(PEOPLE)}")
    outputs = [output / f"{name}.npz" for name in names or PEOPLE]
    check_output(*outputs, force=force)
    build_heads(outputs, parts)
