"""The commands under ``kouxing mos``: a listening test."""

import shlex
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from kouxing.evaluation.tables import show_results
from kouxing.services.cli.options import Assignments, ConfigFile, Language, Output
from kouxing.shared.command.terminal import (
    Force,
    JsonFile,
    check_output,
    plural,
    print_message,
    write_output,
)

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    help="Run listening tests, in which people rate videos.",
)

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the videos.")]


@app.command()
def new(folder: Folder) -> None:
    """Create a study from videos named CONDITION/SENTENCE.mp4.

    A condition with the name reference is the hidden reference, and anchor is the low anchor.
    """
    from kouxing.evaluation.mos.study import new_study

    study = new_study(folder)
    sizes = (plural(len(study.sentences), "sentence"), plural(len(study.conditions), "condition"))
    print_message(f"created a study of {' in '.join(sizes)}; {_next_step(folder)}")


@app.command()
def heads(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder for the study.")],
    recordings: Annotated[
        list[Path],
        typer.Argument(
            metavar="AUDIO", help="Speech and laughter, padded with pauses to one minute."
        ),
    ],
    language: Language = None,
) -> None:
    """Create a study of the built-in heads, with a one-minute video of each head."""
    from kouxing.evaluation.head_videos import write_head_videos
    from kouxing.evaluation.mos.study import check_no_study, new_study
    from kouxing.services.recognizer.acoustic.languages import load_model_for_language

    check_no_study(folder)
    write_head_videos(folder, load_model_for_language(language), recordings)
    study = new_study(folder)
    count = plural(len(study.conditions), "head")
    print_message(f"created a study of {count}; {_next_step(folder)}")


@app.command()
def serve(folder: Folder, config: ConfigFile = None, assignments: Assignments = None) -> None:
    """Serve the page of a study until Ctrl-C, with the settings of the gateway."""
    import asyncio

    from kouxing.evaluation.mos import server
    from kouxing.evaluation.mos.store import AnswerStore
    from kouxing.evaluation.mos.study import load_study
    from kouxing.services.gateway.config import GatewayConfig
    from kouxing.services.service_kinds import read_settings
    from kouxing.shared.settings.config import parse_assignments

    settings = read_settings(config, parse_assignments(assignments or [], "gateway"))
    gateway = settings.load(GatewayConfig)
    study, store = load_study(folder), AnswerStore(folder)
    try:
        asyncio.run(
            server.serve(study, store, gateway, lambda url: print_message(f"judges open {url}"))
        )
    finally:
        store.close()


@app.command()
def report(folder: Folder, json_file: JsonFile = None, force: Force = False) -> None:
    """Print mean opinion scores with 95 % confidence intervals, with and without outliers."""
    from kouxing.evaluation.mos.report import make_report, opinions_table
    from kouxing.evaluation.mos.store import read_answers
    from kouxing.evaluation.mos.study import load_study

    check_output(json_file, force=force)
    opinions = make_report(load_study(folder), read_answers(folder))
    results = {"opinions": [asdict(opinion) for opinion in opinions]}
    show_results(json_file, results, opinions_table(opinions))


@app.command()
def export(folder: Folder, output: Output = None, force: Force = False) -> None:
    """Write every score as a line of CSV, to standard output or a file."""
    from kouxing.evaluation.mos.report import to_csv
    from kouxing.evaluation.mos.store import read_answers
    from kouxing.evaluation.mos.study import load_study

    check_output(output, force=force)
    load_study(folder)  # raises UserError if the folder is not a study
    write_output(to_csv(read_answers(folder)), output)


def _next_step(folder: Path) -> str:
    return f"next: kouxing mos serve {shlex.quote(str(folder))}"
