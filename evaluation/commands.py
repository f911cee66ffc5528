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

from kouxing.shared.face.lip_models import LipModelName
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
    lips: Annotated[
        list[LipModelName] | None, typer.Option(help="Lip model; repeatable; else all.")
    ] = None,
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
    lip_models = lips or list(LipModelName)
    heard = hear_all(model, listeners, chosen)
    outcome = evaluate(heard, listeners, lip_models)
    print_outcome(outcome, Console())
    write_json(json_file, asdict(outcome))
    if videos:
        written = film_all(
            heard,
            listeners,
            lip_models,
            videos,
            has_anchor=anchor,
            sound_at_once=sound_at_once,
        )
        print_message(f"wrote {len(written)} videos to {videos}")
        if any(each.aligned is None for each in heard):
            print_message("none of scheme 1: the text of some sentences is not known")


@app.command()
def rivals(
    clips: Annotated[Path, typer.Option(help="Folder of tracked lips with sound.")],
    picture: Annotated[
        Path | None, typer.Option(help="Picture of the figures over the delay (.png).")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Compare the lip models with HeadAudio, wLipSync and loudness at several delays.

    These run in Node; 'npm ci' in evaluation/lips/rivals installs them.
    """
    from kouxing.corpora.figures import save_figure
    from kouxing.evaluation.lips.report import print_comparison
    from kouxing.evaluation.lips.rivals.comparison import figure, main

    check_output(picture, json_file)
    scores = main(clips)
    print_comparison(scores, Console())
    if picture is not None:
        save_figure(figure(scores), picture)
    write_json(json_file, [asdict(score) for score in scores])


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
def contour(
    picture: Annotated[
        Path | None, typer.Option(help="Picture of contours and curvatures (.png).")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Check the shapes of the Ferguson lips: gap, outline, bends and dents at every opening."""
    import numpy as np

    from kouxing.corpora.figures import save_figure
    from kouxing.evaluation.lips.contour_shapes import check_shapes, print_shapes, shapes_figure

    check_output(picture, json_file)
    figures = check_shapes(np.linspace(0.0, 5.0, 501))
    print_shapes(figures, Console())
    if picture is not None:
        save_figure(shapes_figure(), picture)
    write_json(json_file, {name: values.tolist() for name, values in asdict(figures).items()})


@app.command()
def closures(
    clips: Annotated[Path, typer.Option(help="Folder of tracked lips with sound.")],
    json_file: JsonFile = None,
) -> None:
    """Compare how the learnt lips may weigh evidence of closures, on clips for choices."""
    from kouxing.evaluation.lips.closure_fit import main, print_scores

    check_output(json_file)
    scores = main(clips)
    print_scores(scores, Console())
    write_json(json_file, [asdict(score) for score in scores])


@app.command()
def voices(
    clips: Annotated[Path, typer.Option(help="Folder of tracked lips with sound.")],
    lips: Annotated[Path | None, typer.Option(help="Model of lips (.npz).")] = None,
    speaker: Annotated[
        list[str] | None,
        typer.Option(
            help="Speakers whom the model has not learnt from; repeatable. Else those whom the "
            "model that ships has not."
        ),
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Show what some seconds of a speaker's own lips bring, on clips held out."""
    from kouxing.evaluation.lips.voices import print_scores, score_voices
    from kouxing.services.recognizer.lips import LIPS_PATH

    check_output(json_file)
    scores = score_voices(clips, lips or LIPS_PATH, speaker or ())
    print_scores(scores, Console())
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
def endpoints(
    manifest: Manifest,
    audio: Audio = None,
    split: Split = "dev",
    picture: Annotated[
        Path | None, typer.Option(help="Picture of the pieces over a waveform (.png).")
    ] = None,
    recording: Annotated[
        str | None, typer.Option(help="The recording to draw; else the first one.")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Compare syllables found by energy and zero crossings with forced alignment."""
    from kouxing.corpora.figures import save_figure
    from kouxing.evaluation.lips.segmentation import figure, print_score, score_segmentation
    from kouxing.shared.errors import UserError

    check_output(picture, json_file)
    score, recordings = score_segmentation(manifest, split, audio)
    print_score(score, Console())
    write_json(json_file, asdict(score))
    if picture is not None:
        chosen = [one for one in recordings if recording in (None, one.name)]
        if not chosen:
            raise UserError(f"there is no recording {recording!r} in split {split!r}")
        save_figure(figure(chosen[0]), picture)


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


@app.command()
def senders(
    audio: Annotated[Path, typer.Argument(help="Audio file to stream.")] = SENTENCE,
    seconds: Annotated[float, typer.Option(min=10.0, help="How long to speak at least.")] = 60.0,
    json_file: JsonFile = None,
) -> None:
    """Measure how many frames arrive at other programs that show the face, and how evenly."""
    from kouxing.evaluation.system.sending import measure, show

    check_output(json_file)
    arrivals = measure(audio, seconds, CONSOLE)
    show(arrivals, Console())
    write_json(json_file, [asdict(arrival) for arrival in arrivals])


@app.command()
def control(
    workers: Annotated[
        int, typer.Option(min=2, max=1500, help="Recognizers and synthesizers together.")
    ] = 1000,
    sessions: Annotated[int, typer.Option(min=1, help="Sessions that they serve.")] = 100_000,
    json_file: JsonFile = None,
) -> None:
    """Measure what many workers and sessions cost one control: CPU, memory, delay of an open.

    The workers are played: each sends its heartbeats and starts what it is told. A tenth and a
    hundredth of them are measured, too.
    """
    from kouxing.evaluation.system.control_scale import measure, show

    check_output(json_file)
    costs = [
        measure(max(2, workers // part), max(1, sessions // part), CONSOLE) for part in (100, 10, 1)
    ]
    show(costs, Console())
    write_json(json_file, [asdict(cost) for cost in costs])


@app.command()
def soak(
    audio: Annotated[
        list[Path] | None, typer.Argument(help="Recordings to speak; else the samples.")
    ] = None,
    hours: Annotated[float, typer.Option(min=0.0, help="Of sound; one round at least.")] = 24.0,
    picture: Annotated[Path | None, typer.Option(help="Picture of the curves (.png).")] = None,
    json_file: JsonFile = None,
) -> None:
    """Speak without end, as fast as the services work: drift, memory, lost phones.

    The file is written after each round, so an interrupted run keeps its figures.
    """
    from kouxing.corpora.figures import save_figure
    from kouxing.evaluation.system.soak import Round, draw, measure, show, summary

    def keep(rounds: list[Round]) -> None:
        figures = [asdict(each) for each in rounds]
        write_json(json_file, {"rounds": figures, "summary": summary(rounds)})

    check_output(picture, json_file)
    recordings = audio or sorted(SENTENCE.parent.glob("*.wav"))
    rounds = measure(recordings, hours, CONSOLE, keep)
    show(rounds, Console())
    if picture is not None:
        save_figure(draw(rounds), picture)


@bench_app.command()
def chain(
    audio: Annotated[Path, typer.Argument(help="Audio file to stream.")],
    repeats: Annotated[int, typer.Option(min=1, help="How often to stream it.")] = 3,
    json_file: JsonFile = None,
) -> None:
    """Measure latency, CPU and images per second of the whole chain on this machine.

    The page is measured where Chromium is installed, and how far its sound is from its picture.
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
        | {"page": asdict(figures) if figures is not None else {}},
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


@plot_app.command(name="visemes")
def plot_visemes(
    folder: Annotated[Path, typer.Argument(help="Folder for the pictures.")] = Path("out/visemes"),
    audio: Annotated[Path, typer.Option(help="The sentence to draw.")] = SENTENCE,
    parameters: Annotated[Path | None, typer.Option(help="Viseme parameters (.json).")] = None,
) -> None:
    """Draw the visemes' faces, their dominance curves, and the FAP curves of a sentence."""
    from kouxing.evaluation.lips.viseme_plots import plot_visemes as draw

    for path in draw(folder, audio, parameters):
        print_message(f"wrote {path}")


@plot_app.command(name="lip-line")
def plot_lip_line(
    output: Annotated[Path, typer.Argument(help="Picture to write (.png).")],
) -> None:
    """Draw the head's lips beside lips that plain zones of influence move; print their bumps."""
    from kouxing.corpora.figures import save_figure
    from kouxing.evaluation.lips.lip_line import lip_line_figure, print_lip_lines

    check_output(output)
    print_lip_lines(Console())
    save_figure(lip_line_figure(), output)
    print_message(f"wrote {output}")


@plot_app.command(name="mouths")
def plot_mouths(
    folder: Annotated[Path, typer.Argument(help="Folder for the pictures.")] = Path("out/mouths"),
) -> None:
    """Draw visemes and expressions on every head, and mouths with more or less expressiveness."""
    from kouxing.evaluation.lips.mouth_sheets import draw_mouth_sheets

    for path in draw_mouth_sheets(folder):
        print_message(f"wrote {path}")


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
