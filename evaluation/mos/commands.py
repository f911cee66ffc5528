"""The commands under ``kouxing mos``: a listening test of any set of videos."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from kouxing.services.cli.options import Assignments, ConfigFile
from kouxing.shared.terminal import JsonFile, check_output, print_message, write_json, write_output

app = typer.Typer(no_args_is_help=True, add_completion=False, help="Let people judge videos.")

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the videos.")]


@app.command()
def new(
    folder: Folder,
    title: Annotated[str, typer.Option(help="What judges read; else the folder's name.")] = "",
    reference: Annotated[str, typer.Option(help="Condition that is the hidden reference.")] = "",
    anchor: Annotated[str, typer.Option(help="Condition that is bad on purpose.")] = "",
    language: Annotated[
        list[str] | None, typer.Option(help="Of the page: zh, en; repeatable, else both.")
    ] = None,
    condition: Annotated[
        list[str] | None, typer.Option(help="Take this condition; repeatable, else all.")
    ] = None,
) -> None:
    """Make a study of videos named CONDITION/SENTENCE.mp4 or SENTENCE_CONDITION.mp4."""
    from kouxing.evaluation.mos.study import LANGUAGES, new_study

    study = new_study(
        folder,
        title=title,
        reference=reference,
        anchor=anchor,
        languages=tuple(language or LANGUAGES),
        conditions=condition or (),
    )
    sizes = f"{len(study.sentences)} sentences x {len(study.conditions)} conditions"
    print_message(f"a study of {sizes}; next: kouxing mos serve {folder}")


@app.command()
def serve(
    folder: Folder,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Instead of gateway.port; 0: a free one.")
    ] = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
) -> None:
    """Serve a study's page until Ctrl-C, where and for whom the gateway.* settings say."""
    import asyncio

    from kouxing.evaluation.mos import server
    from kouxing.evaluation.mos.store import Store
    from kouxing.evaluation.mos.study import load_study
    from kouxing.services.gateway.config import GatewayConfig
    from kouxing.services.kinds import read_settings
    from kouxing.shared.config import parse_assignments

    overrides = {} if port is None else {"port": str(port)}
    settings = read_settings(config, parse_assignments(assignments or []))
    gateway = settings.load(GatewayConfig, overrides)
    study = load_study(folder)
    store = Store(folder)
    try:
        asyncio.run(
            server.serve(study, store, gateway, lambda url: print_message(f"judges open {url}"))
        )
    finally:
        store.close()


@app.command()
def report(
    folder: Folder,
    picture: Annotated[Path | None, typer.Option(help="Box plots (.png).")] = None,
    json_file: JsonFile = None,
) -> None:
    """Print mean opinion scores without outliers, and which conditions differ."""
    from kouxing.corpora.figures import save_figure
    from kouxing.evaluation.mos.report import draw_boxes, make_report, print_report
    from kouxing.evaluation.mos.store import read_answers
    from kouxing.evaluation.mos.study import load_study

    check_output(picture, json_file)
    study = load_study(folder)
    answers = read_answers(study.folder)
    found = make_report(study, answers)
    print_report(study, found, Console())
    if picture is not None:
        save_figure(draw_boxes(study, answers), picture)
    write_json(json_file, asdict(found))


@app.command()
def export(
    folder: Folder,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="CSV file; else standard output.")
    ] = None,
) -> None:
    """Write every score as a line of CSV."""
    from kouxing.evaluation.mos.report import to_csv
    from kouxing.evaluation.mos.store import read_answers
    from kouxing.evaluation.mos.study import load_study

    check_output(output)
    study = load_study(folder)
    write_output(to_csv(study, read_answers(study.folder)), output)
