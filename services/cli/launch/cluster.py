"""``kouxing cluster``: recognizers and synthesizers on the hosts of a Ray cluster."""

from typing import Annotated

import typer

from kouxing.services.cli.options import Assignments, ConfigFile
from kouxing.services.service_kinds import KINDS, read_settings
from kouxing.shared.command.terminal import print_table
from kouxing.shared.errors import UserError, install_command
from kouxing.shared.settings.config import parse_assignments

NumWorkers = Annotated[
    int | None, typer.Option(min=0, max=1000, help="Number to run. Default: the current number.")
]


def cluster(
    recognizers: NumWorkers = None,
    synthesizers: NumWorkers = None,
    config: ConfigFile = None,
    assignments: Assignments = None,
) -> None:
    """Scale the workers on a Ray cluster to the given numbers, then list them."""
    settings = read_settings(config, parse_assignments(assignments or []))
    try:
        from kouxing.services.cli.launch.ray_workers import RayWorkers
    except ModuleNotFoundError:
        command = install_command("kouxing[cluster]")
        raise UserError(
            f"Ray is not installed; on every host of the cluster, run: {command}"
        ) from None
    with RayWorkers() as workers:
        for name, number in (("recognizer", recognizers), ("synthesizer", synthesizers)):
            if number is not None:
                workers.scale(KINDS[name], number, settings)
        hosts = workers.hosts()
    if not hosts:
        typer.echo("no workers are running on this cluster")
        return
    print_table(("worker", "host"), hosts.items())
