"""The commands ``kouxing bench``, and ``attacks`` and ``faults`` of ``kouxing evaluate``."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from kouxing.corpora.options import OptionalClips, Picture
from kouxing.evaluation.source_tree import SAMPLE
from kouxing.evaluation.tables import figures_table, show_results
from kouxing.services.cli.options import Language
from kouxing.services.recognizer.sessions.hop_controller import MAX_HOP_BLOCKS
from kouxing.shared.command.terminal import CONSOLE, Force, JsonFile, check_output

AudioFile = Annotated[Path, typer.Argument(help="Audio file to stream.")]
AudioFiles = Annotated[
    list[Path] | None, typer.Argument(help="Audio files to stream. Default: the samples.")
]
Seconds = Annotated[float, typer.Option(min=1.0, help="Duration of each step, seconds.")]


class BenchGroup(TyperGroup):
    """Accepts ``kouxing bench my.wav`` for ``kouxing bench latency my.wav``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert the command if it is missing."""
        if args and args[0] not in {*self.commands, *self.get_help_option_names(ctx)}:
            args = ["latency", *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=BenchGroup,
    no_args_is_help=True,
    add_completion=False,
    help="Measure speed and load. 'kouxing bench my.wav' means 'kouxing bench latency my.wav'.",
)


@app.command(name="latency")
def measure_latency(
    audio: AudioFile, language: Language = None, json_file: JsonFile = None, force: Force = False
) -> None:
    """Measure latency, CPU time and frames per second of the whole pipeline on this machine.

    If Chromium is installed, the page is also measured. --language applies only to latency.
    """
    from kouxing.evaluation.report.system_tables import system_table
    from kouxing.evaluation.system import chromium, costs, latency, page

    check_output(json_file, force=force)
    results = asdict(latency.measure(audio, CONSOLE, language))
    results["sessions"] = costs.measure_sessions(audio)
    results["rendering"] = asdict(costs.measure_images())
    drawings = page.measure(audio, CONSOLE) if chromium.find_chromium() else {}
    results["page"] = {"drawings": {name: asdict(drawing) for name, drawing in drawings.items()}}
    show_results(
        json_file, results, system_table(latency=results), figures_table({"value": results})
    )


@app.command(name="lips-page")
def lips_page(
    audio: AudioFile, clips: OptionalClips = None, json_file: JsonFile = None, force: Force = False
) -> None:
    """Compare lip sync in the browser: kouxing-lips, HeadAudio, wLipSync, wawa-lipsync.

    The figures are download, time to load, processor time and, with clips, accuracy. Needs
    Chromium. Other packages are compared after `npm ci` in the folder of kouxing-lips.
    """
    from kouxing.evaluation.report.system_tables import system_table
    from kouxing.evaluation.system.lips_page import measure

    check_output(json_file, force=force)
    pages = [asdict(page) for page in measure(audio, clips)]
    results = {**pages[0], "others": pages[1:]}
    columns = {page["name"]: page for page in pages}
    show_results(json_file, results, system_table(browser=results), figures_table(columns))


@app.command()
def sizes(json_file: JsonFile = None, force: Force = False) -> None:
    """Measure model sizes, and the minimum processor time of the networks on this machine."""
    from kouxing.evaluation.report.system_tables import system_table
    from kouxing.evaluation.system.sizes import measure

    check_output(json_file, force=force)
    sizes = measure()
    floors = {f"hop {hop}": sizes.floor_cores(hop) for hop in (1, MAX_HOP_BLOCKS)}
    results = {**asdict(sizes), "floor_cores": floors}
    show_results(json_file, results, system_table(sizes=results), figures_table({"value": results}))


@app.command()
def load(
    audio: AudioFiles = None,
    sessions: Annotated[
        int, typer.Option(min=1, max=1000, help="Number of sessions in the last step.")
    ] = 24,
    seconds: Seconds = 12.0,
    language: Language = None,
    picture: Picture = None,
    json_file: JsonFile = None,
    force: Force = False,
) -> None:
    """Measure how many live sessions the services can serve on this machine.

    A single client process streams to all sessions, with different voices. The number of sessions
    grows in up to 9 steps.
    """
    from kouxing.corpora.figures import save_figure
    from kouxing.evaluation.report.system_tables import system_table
    from kouxing.evaluation.system.load import draw, measure

    check_output(picture, json_file, force=force)
    paths = audio or sorted(SAMPLE.parent.glob("*.wav"))
    figures = measure(paths, sessions, seconds, CONSOLE, language)
    results = {**asdict(figures), "summary": figures.summary}
    steps = {str(step["num_asked"]): step for step in results["steps"]}
    summary = {"value": {"machine_load": figures.machine_load, **figures.summary}}
    show_results(
        json_file, results, figures_table(steps), system_table(load=results), figures_table(summary)
    )
    if picture is not None:
        save_figure(draw(figures), picture)


@app.command()
def busy(
    audio: AudioFiles = None,
    programs: Annotated[
        list[int] | None,
        typer.Option(min=0, max=100, help="Number of busy programs; repeatable. Default: 0, 2, 6."),
    ] = None,
    seconds: Seconds = 30.0,
    language: Language = None,
    json_file: JsonFile = None,
    force: Force = False,
) -> None:
    """Measure the lateness of a live face while other programs keep the processor busy.

    Also measures the processor time and the wake-ups of each service. Needs Linux.
    """
    from kouxing.evaluation.report.system_tables import system_table
    from kouxing.evaluation.system.busy import measure

    check_output(json_file, force=force)
    paths = audio or sorted(SAMPLE.parent.glob("*.wav"))
    figures = measure(paths, programs or (0, 2, 6), seconds, CONSOLE, language)
    results = {**asdict(figures), "summary": [run.summary for run in figures.runs]}
    summaries = {f"{run.num_programs} programs": run.summary for run in figures.runs}
    usage = {"silence": results["idle"], "one session": results["speaking"]}
    show_results(
        json_file,
        results,
        system_table(busy=results),
        figures_table(summaries),
        figures_table(usage),
    )


def attacks(json_file: JsonFile = None, force: Force = False) -> None:
    """Measure what attackers cost the services (memory) and other clients (delay)."""
    from kouxing.evaluation.report.system_tables import attacks_table
    from kouxing.evaluation.system.attacks import measure

    check_output(json_file, force=force)
    results = [asdict(result) for result in measure(SAMPLE, CONSOLE)]
    show_results(json_file, results, attacks_table(results))


def faults(
    fault: Annotated[
        list[str] | None, typer.Option(help="Name of a fault; repeatable. Default: all.")
    ] = None,
    logs: Annotated[Path | None, typer.Option(help="Folder for the services' logs.")] = None,
    json_file: JsonFile = None,
    force: Force = False,
) -> None:
    """Measure how faults affect a live face: how long it stops, lost frames, and jumps.

    Faults on this machine: "none", "recognizer killed", "recognizer stopped", "recognizer hangs",
    the same for "synthesizer", each of these also with ", one more" worker of the same kind,
    "control killed", "busy machine" and "16 sessions".

    Faults between hosts: "hosts, 0 ms, 0% lost" (also 20 and 50 ms, 1% and 3%), "hosts, client cut
    off for 2 s", "hosts, recognizer gone for good, one more" and the same for "synthesizer".
    """
    from kouxing.evaluation.report.system_tables import faults_table
    from kouxing.evaluation.system.faults import TIMING, measure

    check_output(json_file, force=force)
    outcomes = measure(SAMPLE, fault or (), logs, CONSOLE, TIMING)
    results = [asdict(outcome) for outcome in outcomes]
    show_results(json_file, results, faults_table(results))
