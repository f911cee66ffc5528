"""The commands ``kouxing bench``, and those under ``kouxing evaluate`` and ``kouxing plot``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from typer.core import TyperGroup

from kouxing.shared.terminal import CONSOLE, JsonFile, check_output, print_message, write_json

if TYPE_CHECKING:
    from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel


class BenchGroup(TyperGroup):
    """Takes ``kouxing bench my.wav`` for ``kouxing bench chain my.wav``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the command in front where there is none."""
        if args and args[0] not in {*self.commands, *self.get_help_option_names(ctx)}:
            args = ["chain", *args]
        return super().parse_args(ctx, args)


app = typer.Typer(no_args_is_help=True, add_completion=False, help="Measure the models.")
plot_app = typer.Typer(no_args_is_help=True, add_completion=False)
bench_app = typer.Typer(cls=BenchGroup, add_completion=False, help="Measure the running system.")

Manifest = Annotated[Path, typer.Option(help="Manifest or corpus folder.")]
Audio = Annotated[
    Path | None,
    typer.Option(help="Folder that the manifest's paths start from, instead of its own."),
]
Split = Annotated[str, typer.Option(help="Its split.")]
Acoustic = Annotated[
    list[str] | None, typer.Option(help="neural, blocks, gmm or a model file; repeatable.")
]
LookAhead = Annotated[
    list[float] | None,
    typer.Option("--look-ahead-ms", help="Look-ahead of models that have one; repeatable."),
]


class Part(StrEnum):
    """What clips are for."""

    CHOICE = "choice"  # choosing settings
    HELD = "held"  # scoring


SENTENCE = Path(__file__).parents[1] / "shared" / "demo" / "hello-female.wav"


@app.command()
def recognizer(
    manifest: Manifest,
    audio: Audio = None,
    split: Split = "test",
    acoustic: Acoustic = None,
    look_ahead: LookAhead = None,
    confusions: Annotated[
        Path | None, typer.Option(help="Picture of the last model's confusions (.png).")
    ] = None,
    curve: Annotated[
        Path | None, typer.Option(help="Picture of the errors over the delay (.png).")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Measure phone and viseme errors, delays and cost of acoustic models, side by side."""
    from kouxing.evaluation.recognizer.confusions import draw_confusions
    from kouxing.evaluation.recognizer.delay_curve import draw_delay_curve
    from kouxing.evaluation.recognizer.error_rates import evaluate_recognizer
    from kouxing.evaluation.recognizer.report import print_figures

    check_output(confusions, curve, json_file)
    results = {
        title: {
            "acoustic": name,
            **evaluate_recognizer(model, manifest, split, audio=audio, own_rule=rule),
        }
        for title, name, model, rule in _models(acoustic, look_ahead)
    }
    print_figures(results, Console())
    write_json(json_file, results)
    if confusions is not None:
        draw_confusions(list(results.values())[-1], confusions)
    if curve is not None:
        draw_delay_curve(list(results.values()), curve)


@app.command()
def robustness(
    manifest: Manifest,
    audio: Audio = None,
    split: Split = "test",
    acoustic: Acoustic = None,
    look_ahead: LookAhead = None,
    other_language: Annotated[
        Path | None, typer.Option(help="Folder of recordings in another language.")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Measure errors in disturbed speech, and phones recognised in sounds without speech."""
    from kouxing.evaluation.recognizer.robustness import evaluate_robustness, print_robustness

    check_output(json_file)
    results = {
        title: evaluate_robustness(
            model, manifest, split, audio=audio, own_rule=rule, other_language=other_language
        )
        for title, _, model, rule in _models(acoustic, look_ahead)
    }
    print_robustness(results, Console())
    write_json(json_file, results)


def _models(
    names: list[str] | None, look_aheads_ms: list[float] | None
) -> Iterator[tuple[str, str, AcousticModel, tuple[int, float]]]:
    """Load models, each with every look-ahead that is given, or else with the one that suits it.

    Yields title, name, model, and the output rule that suits it.
    """
    from kouxing.services.recognizer.acoustic.load import DEFAULT_MODEL, load_live_model
    from kouxing.services.recognizer.config import RecognizerConfig

    for name in names or [DEFAULT_MODEL]:
        suited = RecognizerConfig(acoustic=name)
        rule = suited.num_stable_frames, suited.min_confidence
        for look_ahead_ms in look_aheads_ms or [suited.look_ahead_ms]:
            model = load_live_model(name, look_ahead_ms=look_ahead_ms)
            title = f"{name}, {look_ahead_ms:g} ms look-ahead" if look_aheads_ms else name
            yield title, name, model, rule


@app.command()
def lips(
    clips: Annotated[Path, typer.Option(help="Folder of tracked lips with sound.")],
    parameters: Annotated[Path | None, typer.Option(help="Viseme parameters (.json).")] = None,
    source: Annotated[
        list[str] | None,
        typer.Option(help="Only clips whose names begin with this and _; repeatable."),
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Compare every lip model with tracked lips, at several delays, on held-out clips.

    The file has all figures by language, source and speaker, too.
    """
    from kouxing.evaluation.lips.report import print_scores
    from kouxing.evaluation.lips.scores import main

    check_output(json_file)
    scores = main(clips, parameters, source or ())
    print_scores(scores, Console())
    write_json(json_file, [asdict(score) for score in scores])


@app.command()
def schemes(
    manifest: Annotated[
        Path | None, typer.Option(help="Manifest or corpus folder: 20 sentences of it.")
    ] = None,
    audio: Audio = None,
    split: Split = "test",
    clips: Annotated[
        Path | None, typer.Option(help="Folder of tracked lips with sound: these sentences.")
    ] = None,
    acoustic: Acoustic = None,
    lips: Annotated[list[str] | None, typer.Option(help="Lip model; repeatable; else all.")] = None,
    paper_rule: Annotated[
        bool, typer.Option("--paper-rule", help="Phones as in the paper: N = 3, never corrected.")
    ] = False,
    videos: Annotated[
        Path | None, typer.Option(help="Write CONDITION/SENTENCE.mp4 there, unless they exist.")
    ] = None,
    anchor: Annotated[
        bool, typer.Option("--anchor", help="With --videos: a mouth at rest, bad on purpose.")
    ] = False,
    sound_at_once: Annotated[
        bool,
        typer.Option("--sound-at-once", help="With --videos: sound does not wait for live faces."),
    ] = False,
    json_file: JsonFile = None,
) -> None:
    """Compare the four schemes of Li et al. 2011: aligned, recognised, live, next phone.

    Without a corpus or clips the sentences are the samples that come with kouxing, without
    --acoustic the recognizers blocks and gmm.
    """
    from kouxing.evaluation.lips import sentences
    from kouxing.evaluation.lips.four_schemes import film_all, hear_all, listeners_of
    from kouxing.evaluation.lips.scheme_report import print_outcome
    from kouxing.evaluation.lips.scheme_scores import evaluate
    from kouxing.services.lip_models import lip_models
    from kouxing.services.recognizer.acoustic.load import load_live_model
    from kouxing.shared.errors import UserError

    check_output(json_file)
    if manifest and clips:
        raise UserError("--manifest and --clips both name sentences; give one of them")
    model = load_live_model()
    if manifest:
        chosen = sentences.of_corpus(model, manifest, split, audio)
    elif clips:
        chosen = sentences.of_clips(model, clips)
    else:
        chosen = sentences.of_samples(model, SENTENCE.parent)
    listeners = listeners_of(acoustic or ["blocks", "gmm"], has_paper_rule=paper_rule)
    names = lips or list(lip_models())
    heard = hear_all(model, listeners, chosen)
    outcome = evaluate(heard, listeners, names)
    print_outcome(outcome, Console())
    write_json(json_file, asdict(outcome))
    if videos:
        written = film_all(
            heard,
            listeners,
            names,
            videos,
            has_anchor=anchor,
            sound_at_once=sound_at_once,
        )
        print_message(f"wrote {len(written)} videos to {videos}")
        if any(each.aligned is None for each in heard):
            print_message("none of scheme 1: the text of some sentences is not known")


@app.command()
def ferguson(
    clips: Annotated[Path, typer.Option(help="Folder of tracked lips with sound.")],
    part: Annotated[Part, typer.Option(help="Which clips.")] = Part.HELD,
    picture: Annotated[
        Path | None, typer.Option(help="Picture of the accuracy over the rate (.png).")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Compare lips with real ones at several speaking rates, as Zhang et al. 2021 do."""
    from kouxing.corpora.figures import save_figure
    from kouxing.evaluation.lips.contour_accuracy import print_rates, rates_figure, score_rates

    check_output(picture, json_file)
    scores = score_rates(clips, part)
    print_rates(scores, Console())
    if picture is not None:
        save_figure(rates_figure(scores), picture)
    write_json(json_file, [asdict(score) for score in scores])


@app.command()
def visemes(
    clips: Annotated[Path, typer.Option(help="Folder of tracked lips with sound.")],
    parameters: Annotated[Path | None, typer.Option(help="Viseme parameters (.json).")] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Picture of measured and modelled curves (.png).")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Show how the visemes fit lips they were not trained on, and what training changed."""
    from kouxing.evaluation.lips.viseme_fit import main

    check_output(picture, json_file)
    write_json(json_file, main(clips, parameters, picture))


@app.command()
def attacks(
    audio: Annotated[Path, typer.Argument(help="Audio file to stream.")] = SENTENCE,
    attack: Annotated[
        list[str] | None, typer.Option(help="Only this one, by its name; repeatable.")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Measure what hostile peers cost: memory of the services, and delay of others' faces."""
    from kouxing.evaluation.system.attacks import measure, show

    check_output(json_file)
    damages = measure(audio, attack or (), CONSOLE)
    show(damages, Console())
    write_json(json_file, [asdict(damage) for damage in damages])


@app.command()
def faults(
    audio: Annotated[Path, typer.Argument(help="Audio file to stream.")] = SENTENCE,
    fault: Annotated[
        list[str] | None, typer.Option(help="Only this one, by its name; repeatable.")
    ] = None,
    logs: Annotated[Path | None, typer.Option(help="Keep the services' logs there.")] = None,
    json_file: JsonFile = None,
) -> None:
    """Measure what faults do to a live face: how long it stands, what is lost, how it jumps.

    Faults: "none", "recognizer killed", "synthesizer killed", the same with "stopped" and "hangs"
    in place of "killed", each of the six also with ", one more" of its kind behind it, "control
    killed", "busy machine", "16 sessions", "a subscriber stopped", and between hosts of their own
    "hosts, 0 ms, 0% lost" (also 20 and 50 ms, 1% and 3%), "hosts, client cut off for 2 s", "hosts,
    recognizer gone for good, one more", "hosts, synthesizer gone for good, one more".
    """
    from kouxing.evaluation.system.faults import TIMING, measure, show

    check_output(json_file)
    outcomes = list(measure(audio, fault or (), logs, CONSOLE, TIMING))
    show(outcomes, Console())
    write_json(json_file, [asdict(outcome) for outcome in outcomes])


@bench_app.command()
def chain(
    audio: Annotated[Path, typer.Argument(help="Audio file to stream.")],
    repeats: Annotated[int, typer.Option(min=1, help="How often to stream it.")] = 3,
    json_file: JsonFile = None,
) -> None:
    """Measure latency, CPU and images per second of the whole chain on this machine.

    The page is measured if Chromium is installed.
    """
    from kouxing.evaluation.system import chromium, latency, page, rendering, sessions

    delays = latency.measure(audio, repeats, CONSOLE)
    costs = sessions.measure(audio)
    pictures = rendering.measure()
    figures = page.measure(audio, CONSOLE) if chromium.is_installed() else None
    out = Console()
    latency.show(delays, out)
    sessions.show(costs, out)
    rendering.show(pictures, out)
    if figures is not None:
        page.show(figures, out)
    write_json(
        json_file,
        asdict(delays)
        | {"sessions": costs, "rendering": asdict(pictures)}
        | {"page": {"drawings": {name: asdict(each) for name, each in (figures or {}).items()}}},
    )


@bench_app.command()
def load(
    audio: Annotated[
        list[Path] | None, typer.Argument(help="Recordings to speak; else the samples.")
    ] = None,
    sessions: Annotated[
        int, typer.Option(min=1, max=1000, help="As many live sessions at the end.")
    ] = 24,
    seconds: Annotated[
        float, typer.Option(min=1.0, help="How long each of up to 9 numbers is measured.")
    ] = 12.0,
    picture: Annotated[Path | None, typer.Option(help="Picture of the curves (.png).")] = None,
    json_file: JsonFile = None,
) -> None:
    """Measure how many live sessions control, a recognizer and a synthesizer carry here.

    One process speaks into all of them, each with a voice of its own.
    """
    from kouxing.corpora.figures import save_figure
    from kouxing.evaluation.system.load import draw, measure, show

    check_output(picture, json_file)
    figures = measure(audio or sorted(SENTENCE.parent.glob("*.wav")), sessions, seconds, CONSOLE)
    show(figures, Console())
    if picture is not None:
        save_figure(draw(figures), picture)
    write_json(json_file, asdict(figures) | {"summary": figures.summary})


@plot_app.callback()
def plot() -> None:
    """Draw pictures and videos of the models."""


@plot_app.command(name="heads")
def plot_heads(
    folder: Annotated[Path, typer.Argument(help="Folder for the sheets.")] = Path("out/heads"),
    choices: Annotated[
        Path | None, typer.Option(help="Folder for a small picture of every head.")
    ] = None,
) -> None:
    """Draw every head, and the faces of every viseme, from the front and from 40 degrees."""
    from kouxing.evaluation.system.head_pictures import draw_choices, draw_sheets

    for path in draw_sheets(folder) + (draw_choices(choices) if choices else []):
        print_message(f"wrote {path}")


@plot_app.command(name="clip")
def plot_clip(
    name: Annotated[str, typer.Argument(help="Name of the clip.")],
    output: Annotated[Path, typer.Argument(help="Video to write (.mp4, .mov, .webm, .webp).")],
    clips: Annotated[Path, typer.Option(help="Folder of tracked lips with sound.")],
) -> None:
    """Make a video of every lip model beside the tracked lips of a clip."""
    from kouxing.evaluation.lips.clip_video import film_clip

    film_clip(clips, name, output)
    print_message(f"wrote {output}")
