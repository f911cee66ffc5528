"""The commands under ``kouxing evaluate`` and ``kouxing plot``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kouxing.corpora.options import Clips, EmotionalSpeech, OptionalClips, OptionalSounds, Picture
from kouxing.evaluation.source_tree import SAMPLE
from kouxing.evaluation.system.commands import attacks, faults
from kouxing.evaluation.tables import figures_table, show_results
from kouxing.services.cli.options import ACOUSTIC_MODEL
from kouxing.shared.command.terminal import Force, JsonFile, check_output, plural, print_message
from kouxing.shared.errors import UserError

if TYPE_CHECKING:
    from kouxing.corpora.sounds import Sound
    from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
    from kouxing.services.recognizer.search.output_rule import OutputRuleConfig


app = typer.Typer(no_args_is_help=True, add_completion=False, help="Measure models and services.")
plot_app = typer.Typer(no_args_is_help=True, add_completion=False)


# panels of the help
_RECOGNITION, _LIPS, _SYSTEM = "Recognition", "Lips", "Face and services"
_ALL = "All evaluations"

_CORPUS = typer.Option("--corpus", "--manifest", help="Corpus folder or manifest.")
Corpus = Annotated[Path, _CORPUS]
OptionalCorpus = Annotated[Path | None, _CORPUS]
Split = Annotated[str, typer.Option(help="Split of the corpus.")]
Acoustic = Annotated[list[str] | None, typer.Option(help=f"{ACOUSTIC_MODEL}; repeatable.")]
Conditions = Annotated[
    list[str] | None,
    typer.Option(
        "--condition",
        help='Condition of the audio, such as clean or "babble 10 dB"; repeatable. Default: all.',
    ),
]
Tables = Annotated[
    list[Path] | None,
    typer.Option("--from-csv", help="Folder of another program's curves, CLIP.csv; repeatable."),
]


@app.command(rich_help_panel=_RECOGNITION)
def recognizer(
    corpus: Corpus,
    audio: Annotated[
        Path | None, typer.Option(help="Folder of the audio files. Default: the corpus folder.")
    ] = None,
    split: Split = "test",
    acoustic: Acoustic = None,
    sounds: OptionalSounds = None,
    conditions: Conditions = None,
    json_file: JsonFile = None,
    force: Force = False,
) -> None:
    """Compare phone and viseme errors and delays of acoustic models.

    The speech is clean, disturbed by noise, music, other voices, a room or a telephone band, and
    grouped by speaking rate. Without --sounds, the music is synthesized. The JSON file also
    contains figures by speaker, by recording and for other output rules.
    """
    from kouxing.evaluation.recognizer.aligned_corpus import align_corpus
    from kouxing.evaluation.recognizer.disturbances import (
        check_conditions,
        disturbances_for,
        held_out_music,
    )
    from kouxing.evaluation.recognizer.error_rates import evaluate_recognizer
    from kouxing.evaluation.report.recognition_table import speech_table

    check_output(json_file, inputs=[corpus], force=force)
    check_conditions(conditions or ())
    models = list(_models(acoustic))
    music = held_out_music(_read_sounds(sounds))
    references = align_corpus(models[0][1], corpus, split, audio)
    disturbances = disturbances_for(references, music, conditions or ())
    results = {
        name: {"split": split, **evaluate_recognizer(model, references, disturbances, rule)}
        for name, model, rule in models
    }
    show_results(json_file, results, speech_table(results))


@app.command(rich_help_panel=_RECOGNITION)
def languages(
    audio: Annotated[
        Path, typer.Option(help="Folder of the audio files that corpora/languages.tsv lists.")
    ],
    json_file: JsonFile = None,
    force: Force = False,
) -> None:
    """Measure live feature and viseme errors of universal phones by language.

    Each recording is recognized twice: with no language chosen, and with its own language. If the
    package hama is installed (make report), it also recognizes the English recordings.
    """
    from kouxing.corpora.speech_corpus import LANGUAGES
    from kouxing.evaluation.recognizer.aligned_corpus import align_corpus
    from kouxing.evaluation.recognizer.languages import evaluate_languages
    from kouxing.evaluation.report.recognition_table import speech_table
    from kouxing.evaluation.rivals.tables import FOLDER

    check_output(json_file, force=force)
    ((_, model, rule),) = _models(["universal"])
    references = align_corpus(model, LANGUAGES, "test", audio)
    results = evaluate_languages(references, rule, with_hama=(FOLDER / ".venv").exists())
    show_results(json_file, results, speech_table(results))


@app.command(rich_help_panel=_RECOGNITION)
def voice(
    corpus: Corpus,
    split: Split = "test",
    sounds: OptionalSounds = None,
    json_file: JsonFile = None,
    force: Force = False,
) -> None:
    """Measure the fraction of time with voice activity, by kind of audio.

    The audio consists of clean and disturbed speech, the held-out files of --sounds, and
    synthesized voices and noises.
    """
    from kouxing.evaluation.recognizer.aligned_corpus import align_corpus
    from kouxing.evaluation.recognizer.disturbances import (
        BABBLE,
        MUSIC,
        disturbances_for,
        held_out_music,
    )
    from kouxing.evaluation.recognizer.voice_activity import evaluate_voice, labeled_audio
    from kouxing.evaluation.report.recognition_table import voice_table

    check_output(json_file, inputs=[corpus], force=force)
    ((name, model, _),) = _models(None)
    recorded = _read_sounds(sounds)
    music = held_out_music(recorded)
    references = align_corpus(model, corpus, split)
    disturbances = disturbances_for(references, music, (MUSIC, BABBLE))
    materials = labeled_audio(references, disturbances, music, recorded)
    results = evaluate_voice(model, materials)
    show_results(json_file, {name: results}, voice_table(results))


@app.command(rich_help_panel=_SYSTEM)
def face(recordings: EmotionalSpeech, json_file: JsonFile = None, force: Force = False) -> None:
    """Measure the motion of a face apart from its lips: emotion, nods, brows, blinks, stillness."""
    from kouxing.corpora.emotions import read_emotions
    from kouxing.evaluation.face_motion import measure_face
    from kouxing.services.recognizer.acoustic.load import load_model

    check_output(json_file, force=force)
    results = asdict(measure_face(load_model("light"), read_emotions(recordings)))
    show_results(json_file, results, figures_table({"value": results}))


def _read_sounds(folders: list[Path] | None) -> list[Sound]:
    from kouxing.corpora.sounds import read_sounds

    return read_sounds(folders or (), any_license=True)


def _models(names: list[str] | None) -> Iterator[tuple[str, AcousticModel, OutputRuleConfig]]:
    """Yield name, model and default output rule of each model."""
    from kouxing.services.recognizer.acoustic.load import DEFAULT_MODEL, load_model
    from kouxing.services.recognizer.config import RecognizerConfig

    for name in names or [DEFAULT_MODEL]:
        yield name, load_model(name), RecognizerConfig(acoustic=name).output_rule


@app.command(rich_help_panel=_LIPS)
def lips(
    clips: Clips,
    lips: Annotated[
        list[str] | None,
        typer.Option(
            help="Lip model, or file of a lip predictor (.npz) or of visemes (.json); repeatable."
            " Default: all lip models."
        ),
    ] = None,
    delay_ms: Annotated[
        list[float] | None,
        typer.Option(
            min=0.0,
            max=300.0,
            help="Delay of the face in ms; repeatable. Default: the lip model's.",
        ),
    ] = None,
    sounds: OptionalSounds = None,
    conditions: Conditions = None,
    tables: Tables = None,
    json_file: JsonFile = None,
    force: Force = False,
) -> None:
    """Compare live lips with the real ones on held-out clips, in one table.

    The sound is clean, or has babble or music 10 dB below the speech. Without --sounds, the music
    is synthesized. The JSON file also contains the figures by source and speaker. docs/benchmark.md
    explains how to score another program.
    """
    from kouxing.evaluation.lips.lip_scores import CONDITIONS, score_lips
    from kouxing.evaluation.recognizer.disturbances import check_conditions, held_out_music
    from kouxing.evaluation.report.lip_tables import scores_table

    check_output(json_file, force=force)
    if tables and delay_ms and not lips:
        raise UserError("--delay-ms applies to lip models; add --lips MODEL")
    conditions = conditions or list(CONDITIONS)
    check_conditions(conditions, CONDITIONS)
    music = held_out_music(_read_sounds(sounds))
    results = score_lips(clips, lips or (), delay_ms or (), music, conditions, tables or ())
    show_results(json_file, results, scores_table(results))


@app.command(name="lips-package", rich_help_panel=_LIPS)
def lips_package(
    clips: Clips, corpus: OptionalCorpus = None, json_file: JsonFile = None, force: Force = False
) -> None:
    """Compare the package kouxing-lips with the server: lips of clips, and phones of a corpus.

    Needs Node.
    """
    from kouxing.evaluation.report.system_tables import system_table
    from kouxing.evaluation.system.lips_package import compare

    check_output(json_file, force=force)
    results = compare(clips, corpus)
    show_results(json_file, results, system_table(package=results))


@app.command(name="pack-clips", rich_help_panel=_LIPS)
def pack_clips(
    archive: Annotated[Path, typer.Argument(help="Archive to write (.zip).")],
    clips: Clips,
    force: Force = False,
) -> None:
    """Archive the clips whose licenses allow sharing, with their splits and licenses."""
    from kouxing.corpora.lip_clips import write_clip_archive

    check_output(archive, force=force)
    num_clips, closed_licenses = write_clip_archive(clips, archive)
    print_message(f"wrote {plural(num_clips, 'clip')} to {archive}")
    if closed_licenses:
        print_message(f"left out clips with these licenses: {'; '.join(sorted(closed_licenses))}")


@app.command(rich_help_panel=_LIPS)
def rivals(
    output: Annotated[
        Path, typer.Argument(help="Folder for PROGRAM/CLIP.csv; existing files are kept.")
    ],
    clips: Clips,
    program: Annotated[
        list[str] | None, typer.Option(help="Name of a program; repeatable. Default: all.")
    ] = None,
) -> None:
    """Run other lip-sync programs on the clips, and write curves for evaluate lips --from-csv.

    Programs: headaudio, wlipsync, wawa, live2d, pylipsync, openfacefx, loudness, and rhubarb if it
    is on the path.
    """
    from kouxing.evaluation.rivals.tables import PROGRAMS, write_tables

    write_tables(clips, output, program or PROGRAMS)


@app.command(rich_help_panel=_ALL)
def report(
    step: Annotated[list[str] | None, typer.Argument(help="Name of a step. Default: all.")] = None,
    clips: OptionalClips = None,
    corpus: OptionalCorpus = None,
    conversation: Annotated[
        Path | None,
        typer.Option(help="Folder of the audio files that corpora/conversation.tsv lists."),
    ] = None,
    languages: Annotated[
        Path | None,
        typer.Option(help="Folder of the audio files that corpora/languages.tsv lists."),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Measure only part of the data, in about ten minutes.")
    ] = False,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Also run steps that are up to date.")
    ] = False,
) -> None:
    """Run the evaluations that are out of date, and write docs/results.md.

    A step is out of date if the code or the models that it depends on have changed. With --quick,
    the report is written to out/report.
    """
    from kouxing.evaluation.report.page import write_page
    from kouxing.evaluation.report.run import run_steps
    from kouxing.evaluation.report.steps import STEPS
    from kouxing.evaluation.source_tree import ROOT

    unknown = {*(step or ())} - {*STEPS}
    if unknown:
        raise UserError(f"no step {min(unknown)!r}; choose from {', '.join(STEPS)}")
    if not (ROOT / "docs").is_dir():
        raise UserError("the report needs the source tree; run 'make report' there")
    folder = ROOT / "out" / "report" if quick else ROOT / "docs"
    data = {
        "lips": clips,
        "corpus": corpus,
        "natural": conversation,
        "languages": languages,
        "rivals": ROOT / "out" / "rivals",
    }
    results = folder / "results"
    failed = run_steps(step or STEPS, data, results, is_quick=quick, is_fresh=fresh)
    write_page(results, folder / "results.md")
    print_message(f"wrote {folder / 'results.md'}")
    if failed:
        raise UserError(f"these steps failed: {', '.join(failed)}; their messages are above")


@app.command(rich_help_panel=_LIPS)
def schemes(
    corpus: OptionalCorpus = None,
    clips: OptionalClips = None,
    acoustic: Acoustic = None,
    lips: Annotated[
        list[str] | None, typer.Option(help="Lip model; repeatable. Default: all.")
    ] = None,
    paper_rule: Annotated[
        bool,
        typer.Option("--paper-rule", help="Use phones as in the paper: N = 3, no corrections."),
    ] = False,
    videos: Annotated[
        Path | None, typer.Option(help="Folder for CONDITION/SENTENCE.mp4; skips existing files.")
    ] = None,
    tables: Tables = None,
    json_file: JsonFile = None,
    force: Force = False,
) -> None:
    """Compare the four schemes of Li et al. 2011: aligned, recognized, live, next phone.

    The sentences are the shipped samples, 20 of the corpus's split test, or the held-out clips.
    The default models are blocks and gmm. With --videos, --from-csv adds videos of other programs.
    """
    from kouxing.evaluation.lips import sentences
    from kouxing.evaluation.lips.four_schemes import load_recognizers, recognize_all
    from kouxing.evaluation.lips.scheme_scores import score_schemes
    from kouxing.evaluation.lips.scheme_videos import write_videos
    from kouxing.evaluation.report.paper_tables import schemes_table
    from kouxing.services.lip_models import lip_models
    from kouxing.services.recognizer.acoustic.load import load_model

    check_output(json_file, inputs=[corpus], force=force)
    if corpus and clips:
        raise UserError("use either --corpus or --clips, not both")
    if tables and not (videos and clips):
        raise UserError("--from-csv applies to videos of clips; add --videos FOLDER and --clips")
    model = load_model()
    if corpus:
        chosen = sentences.corpus_sentences(model, corpus)
    elif clips:
        chosen = sentences.clip_sentences(model, clips)
    else:
        chosen = sentences.sample_sentences(model, SAMPLE.parent)
    recognizers = load_recognizers(acoustic or ["blocks", "gmm"], uses_paper_rule=paper_rule)
    names = lips or list(lip_models())
    recognized = recognize_all(recognizers, chosen)
    scores = [asdict(score) for score in score_schemes(recognized, recognizers, names)]
    results = {"sentences": [item.sentence.clip.name for item in recognized], "scores": scores}
    agreements = (schemes_table(scores, reference) for reference in ("scheme 1", "real lips"))
    show_results(json_file, results, *(table for table in agreements if table.rows))
    if videos:
        written = write_videos(recognized, recognizers, names, videos, tables or ())
        print_message(f"wrote {plural(len(written), 'video')} to {videos}")
        unaligned = [item.sentence.clip.name for item in recognized if item.aligned is None]
        if unaligned:
            print_message(f"no videos of scheme 1: no usable text for {', '.join(unaligned)}")


@app.command(rich_help_panel=_LIPS)
def ferguson(clips: Clips, json_file: JsonFile = None, force: Force = False) -> None:
    """Compare lip models with tracked lips at several speaking rates, as in Zhang et al. 2021."""
    from kouxing.evaluation.lips.speaking_rates import score_rates
    from kouxing.evaluation.report.paper_tables import ferguson_table

    check_output(json_file, force=force)
    results = [asdict(score) for score in score_rates(clips)]
    show_results(json_file, results, ferguson_table(results))


@app.command(rich_help_panel=_LIPS)
def visemes(
    clips: Clips, picture: Picture = None, json_file: JsonFile = None, force: Force = False
) -> None:
    """Measure how well the visemes fit held-out lips, as in Wang & Cai 2003."""
    from kouxing.corpora.figures import save_figure
    from kouxing.evaluation.lips.viseme_fit import fit_figure, fit_folder, viseme_errors
    from kouxing.evaluation.report.paper_tables import viseme_fit_table

    check_output(picture, json_file, force=force)
    fitted = fit_folder(clips)
    results = {
        "clips": [clip.clip.name for clip in fitted],
        "errors": [asdict(error) for error in viseme_errors(fitted)],
    }
    show_results(json_file, results, viseme_fit_table(results))
    if picture is not None:
        save_figure(fit_figure(fitted), picture)


app.command(rich_help_panel=_SYSTEM)(attacks)
app.command(rich_help_panel=_SYSTEM)(faults)


@plot_app.callback()
def plot() -> None:
    """Draw pictures of the heads and visemes."""


@plot_app.command(name="heads")
def plot_heads(
    folder: Annotated[Path, typer.Argument(help="Folder for the pictures.")] = Path("out/heads"),
    choices: Annotated[
        Path | None, typer.Option(help="Folder for a small picture of every head.")
    ] = None,
    force: Force = False,
) -> None:
    """Draw every head and every viseme, from the front and from 40 degrees."""
    from kouxing.evaluation import head_pictures

    pictures = head_pictures.sheet_renderers(folder) | (
        head_pictures.thumbnail_renderers(choices) if choices else {}
    )
    check_output(*(path for path in pictures if path.exists()), force=force)
    for path, draw in pictures.items():
        head_pictures.save(path, draw())
        print_message(f"wrote {path}")
