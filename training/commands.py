"""The commands under ``kouxing train``."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from kouxing.corpora.options import Clips, EmotionalSpeech, OptionalClips, OptionalSounds, Sounds
from kouxing.services.cli.options import Language
from kouxing.shared.command.terminal import Force, check_output
from kouxing.shared.errors import UserError, install_command
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE, load_inventory

app = typer.Typer(no_args_is_help=True, add_completion=False)

_CORPORA = typer.Option("--corpus", help="Corpus folder or manifest; repeatable.")
Corpora = Annotated[list[Path], _CORPORA]
OptionalCorpora = Annotated[list[Path] | None, _CORPORA]
Model = Annotated[Path, typer.Option("--output", "-o", help="Model file to write.")]
PhoneLm = Annotated[
    Path | None,
    typer.Option(
        help="Phone language model, phone_lm.npz or an acoustic model. Default: a model that is"
        " counted from the corpora."
    ),
]
Whisper = Annotated[
    Path, typer.Option(help="Folder of the Whisper base model, in faster-whisper's format.")
]
StartFrom = Annotated[
    Path | None,
    typer.Option(
        help="Acoustic model that aligns the recordings. Default: the shipped block model."
    ),
]
Untranscribed = Annotated[
    list[Path] | None,
    typer.Option(help="Folder of speech in any language, without texts; repeatable."),
]


@app.callback()
def train(
    context: typer.Context,
    any_license: Annotated[
        bool,
        typer.Option(
            "--any-license",
            help="Also train on recordings whose license does not allow distributing the model.",
        ),
    ] = False,
) -> None:
    """Train the models."""
    if any_license and context.invoked_subcommand in ("phone-lm", "heads"):
        raise UserError(
            f"--any-license does not apply to {context.invoked_subcommand}; leave it out"
        )
    context.obj = any_license


@contextmanager
def _neural_training(output: Path, *, force: bool) -> Iterator[None]:
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
    output: Model,
    corpora: OptionalCorpora = None,
    text: Annotated[
        list[Path] | None, typer.Option("--text", help="Text file, UTF-8; repeatable.")
    ] = None,
    word_model: Annotated[
        Path | None,
        typer.Option(
            help="Folder of a word language model to draw sentences from: pydict_sc.bin of"
            " SunPinyin, and ngrams.txt, the output of tslminfo -v."
        ),
    ] = None,
    language: Language = None,
    force: Force = False,
) -> None:
    """Train a phone language model (.npz) on the texts of corpora, on text files, or both."""
    from kouxing.training.phone_lm.open_gram import DICTIONARY, NGRAMS, draw_phones
    from kouxing.training.phone_lm.recipe import train_phone_lm

    words = [word_model / name for name in (NGRAMS, DICTIONARY)] if word_model else []
    check_output(output, inputs=[*(corpora or []), *(text or []), *words], force=force)
    inventory = load_inventory(language or DEFAULT_LANGUAGE)
    drawn = draw_phones(word_model, inventory) if word_model else None
    train_phone_lm(corpora or [], text or [], output, inventory, drawn=drawn)


@app.command()
def gmm(
    context: typer.Context,
    corpora: Corpora,
    output: Model,
    phone_lm: PhoneLm = None,
    language: Language = None,
    force: Force = False,
) -> None:
    """Train the Gaussian mixture recognizer (.npz), and write its model card."""
    from kouxing.training.gmm.recipe import train_gmm

    check_output(output, inputs=[*corpora, phone_lm], force=force)
    train_gmm(
        corpora,
        output,
        load_inventory(language or DEFAULT_LANGUAGE),
        phone_lm=phone_lm,
        any_license=context.obj,
    )


@app.command()
def blocks(
    context: typer.Context,
    corpora: Corpora,
    output: Model,
    whisper: Whisper,
    start_from: StartFrom = None,
    untranscribed: Untranscribed = None,
    sounds: OptionalSounds = None,
    steps: Annotated[
        int, typer.Option(min=1, help="Number of steps, each with 256 s of audio.")
    ] = 1000,
    force: Force = False,
) -> None:
    """Train the block model (.npz), and write its model card.

    Repeat the command to resume an interrupted run; the number of steps may change. The state of
    the run is stored next to the output, and deleted at the end.
    """
    with _neural_training(output, force=force):
        from kouxing.training.blocks.recipe import train_blocks

    train_blocks(
        corpora,
        output,
        whisper=whisper,
        start=start_from,
        untranscribed=untranscribed or [],
        sounds=sounds or [],
        num_steps=steps,
        any_license=context.obj,
    )


@app.command()
def universal(
    context: typer.Context,
    corpora: Corpora,
    output: Model,
    learners: Annotated[
        list[Path] | None,
        typer.Option(help="Corpus of English by native speakers of Mandarin; repeatable."),
    ] = None,
    languages: Annotated[
        list[Path] | None,
        typer.Option(help="Corpus of other languages, named in its manifest; repeatable."),
    ] = None,
    clips: OptionalClips = None,
    steps: Annotated[
        int, typer.Option(min=1, help="Number of steps, each with 19 s of audio.")
    ] = 2000,
    force: Force = False,
) -> None:
    """Train the universal phones (.npz), and write their model card.

    They are a second readout of the shipped block model. The corpora of --corpus are Mandarin; of
    the clips, those of GRID are used.

    Repeat the command to resume an interrupted run; the number of steps may change. The state of
    the run is stored next to the output, and deleted at the end.
    """
    with _neural_training(output, force=force):
        from kouxing.training.universal.recipe import train_universal

    train_universal(
        corpora,
        output,
        learners=learners or [],
        languages=languages or [],
        clips=clips,
        num_steps=steps,
        any_license=context.obj,
    )


@app.command()
def encoder(
    context: typer.Context,
    corpora: Corpora,
    output: Model,
    whisper: Whisper,
    sounds: Sounds,
    clips: Clips,
    untranscribed: Untranscribed = None,
    steps: Annotated[
        int, typer.Option(min=1, help="Number of steps, each with 140 s of audio.")
    ] = 7000,
    force: Force = False,
) -> None:
    """Train the audio encoder (.npz), and write its model card.

    Repeat the command to resume an interrupted run; the number of steps may change. The state of
    the run is stored next to the output, and deleted at the end.
    """
    with _neural_training(output, force=force):
        from kouxing.training.encoder.recipe import read_sources, train_encoder

    sources = read_sources(corpora, clips, untranscribed or [], sounds, any_license=context.obj)
    train_encoder(sources, output, whisper=whisper, num_steps=steps)


@app.command()
def refined_encoder(
    context: typer.Context,
    corpora: Corpora,
    output: Model,
    start_from: Annotated[Path, typer.Option(help="Audio encoder to refine (.npz).")],
    sounds: Sounds,
    clips: Clips,
    untranscribed: Untranscribed = None,
    steps: Annotated[
        int, typer.Option(min=1, help="Number of steps, each with 140 s of audio.")
    ] = 700,
    force: Force = False,
) -> None:
    """Refine an audio encoder (.npz) with more music and noise, and write its model card.

    It learns to give the same outputs for disturbed audio as for clean audio, and to ignore music.

    Repeat the command to resume an interrupted run; the number of steps may change. The state of
    the run is stored next to the output, and deleted at the end.
    """
    with _neural_training(output, force=force):
        from kouxing.training.encoder.recipe import read_sources, refine_encoder

    sources = read_sources(corpora, clips, untranscribed or [], sounds, any_license=context.obj)
    refine_encoder(sources, output, start=start_from, num_steps=steps)


@app.command()
def visemes(context: typer.Context, clips: Clips, output: Model, force: Force = False) -> None:
    """Train the parameters of the dynamic visemes (.json) on tracked lips."""
    from kouxing.training.visemes.recipe import train_visemes

    check_output(output, force=force)
    train_visemes(clips, output, any_license=context.obj)


@app.command()
def lips(context: typer.Context, clips: Clips, output: Model, force: Force = False) -> None:
    """Train the lip model learned (.npz) on tracked lips, and write its model card."""
    with _neural_training(output, force=force):
        from kouxing.training.lips.recipe import train_lips

    train_lips(clips, output, any_license=context.obj)


@app.command()
def ferguson(
    context: typer.Context, clips: Clips, corpora: Corpora, output: Model, force: Force = False
) -> None:
    """Train the lip model ferguson (.tsv): its openings, durations and influence factors."""
    from kouxing.training.ferguson.recipe import train_ferguson

    check_output(output, force=force)
    train_ferguson(clips, corpora, output, any_license=context.obj)


@app.command()
def traits(
    context: typer.Context,
    recordings: EmotionalSpeech,
    sounds: Sounds,
    output: Model,
    force: Force = False,
) -> None:
    """Train the readout of arousal, valence, laughter and breath (.npz), with its model card."""
    from kouxing.training.voice_traits import train_traits

    check_output(output, force=force)
    train_traits(recordings, sounds, output, any_license=context.obj)


@app.command()
def heads(
    parts: Annotated[
        Path, typer.Option(help="Folder with MakeHuman's hair, brows, lashes, eyes and skins.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the heads, NAME.npz.")],
    names: Annotated[list[str] | None, typer.Argument(help="Heads to build. Default: all.")] = None,
    force: Force = False,
) -> None:
    """Build the built-in heads from MakeHuman data."""
    from kouxing.training.heads.assemble import build_heads
    from kouxing.training.heads.people import PEOPLE

    if unknown := sorted({*(names or [])} - {*PEOPLE}):
        raise UserError(f"unknown heads: {', '.join(unknown)}; choose from {', '.join(PEOPLE)}")
    outputs = [output / f"{name}.npz" for name in names or PEOPLE]
    check_output(*outputs, force=force)
    build_heads(outputs, parts)
