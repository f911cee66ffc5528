"""Commands that other packages add as entry points."""

import re
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoint, version
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from kouxing.services.cli import main as command_line
from kouxing.services.service_kinds import KINDS
from kouxing.shared.errors import UserError

wave_app = typer.Typer(add_completion=False)


@wave_app.command()
def wave(name: str) -> None:
    """Wave to somebody."""
    typer.echo(f"waving to {name}")


@pytest.fixture
def added(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Add the command above like another package would, and return the requested groups."""
    groups: list[str] = []

    def entry_points(*, group: str) -> list[EntryPoint]:
        groups.append(group)
        return [EntryPoint("wave", f"{__name__}:wave_app", group)]

    monkeypatch.setattr(command_line, "entry_points", entry_points)
    return groups


def test_an_added_command_runs_and_is_listed(added: list[str]) -> None:
    result = CliRunner().invoke(command_line.app, ["wave", "Mei"])
    assert result.output == "waving to Mei\n"
    listed = CliRunner().invoke(command_line.app, ["--help"], env={"COLUMNS": "120"}).output
    assert "Wave to somebody." in listed
    assert all(name in listed for name in KINDS)
    assert set(added) == {"kouxing.commands"}

    result = CliRunner().invoke(command_line.app, ["wafe"])
    assert result.exit_code == 2
    assert "wave" in result.output, "a suggestion"


@pytest.mark.parametrize("command", ["render", "lips", "listen", "phones", "speak"])
def test_the_choices_of_an_option_are_not_broken_in_a_narrow_terminal(command: str) -> None:
    arguments = [command, "--help"]
    printed = CliRunner().invoke(command_line.app, arguments, env={"COLUMNS": "80"}).output
    assert "--help" in printed
    assert not re.findall(r"<[\w|-]+\s", printed)


@pytest.mark.parametrize(
    "group", ["bench", "evaluate", "export", "head", "keys", "mos", "plot", "train"]
)
def test_a_group_without_a_command_lists_its_commands(group: str) -> None:
    printed = CliRunner().invoke(command_line.app, [group]).output
    assert "Usage:" in printed
    assert "Commands" in printed or "evaluations" in printed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("train gmm --any-license", "train --any-license gmm"),
        ("listen --as words", "'--as': 'words' is not one of 'faps'"),
        ("render a.wav --rate 0.5", "--rate 0.5: use a number from 1 to 240"),
        ("render a.wav --speed fast", "--speed fast: use a number from 0.25 to 1"),
        ("run --workers 0", "--workers 0: use an integer from 1 to"),
        ("phones a.wav --track x", "--track x: use an integer"),
        ("bench load --seconds 0", "--seconds 0: use a number of at least 1"),
        ("bench busy --programs 200", "--programs 200: use an integer from 0 to 100"),
        ("spek a.wav", "no such command 'spek'. Did you mean 'speak'? See "),
    ],
)
def test_explains_a_wrong_option(arguments: str, message: str) -> None:
    with pytest.raises(command_line._UsageError) as refused:
        command_line.app(arguments.split(), standalone_mode=False)
    assert message in command_line._usage_text(refused.value)


def test_a_built_in_command_does_not_import_the_added_ones(added: list[str]) -> None:
    assert CliRunner().invoke(command_line.app, ["phones", "--help"]).exit_code == 0
    result = CliRunner().invoke(command_line.app, ["--version"])
    assert result.output == f"kouxing {version('kouxing')}\n"
    assert added == []


@pytest.mark.parametrize(
    ("start", "slow"),
    [
        (
            "import kouxing.services.cli.main",
            "kouxing.training kouxing.evaluation numpy zmq kouxing.services.recognizer.service",
        ),
        (
            "import contextlib, io, kouxing.services.cli.main as main\n"
            "with contextlib.redirect_stdout(io.StringIO()):\n"
            "    main.app(['--help'], standalone_mode=False)",
            "numpy zmq",
        ),
        (
            "from kouxing.services.service_kinds import read_settings; read_settings()",
            "numpy zmq aiohttp",
        ),
        (
            "import kouxing.services.gateway.service",
            "scipy onnxruntime prometheus_client cryptography",
        ),
        (
            "from kouxing.services.driver.service import DriverConfig, View;"
            " View(DriverConfig(view='none'), print)",
            "scipy av moderngl glfw",
        ),
        (
            "import kouxing.services.recognizer.service as service; service.load_numba()",
            "scipy.linalg pycparser aiohttp prometheus_client",
        ),
    ],
    ids=["command", "help", "settings", "gateway", "driver", "recognizer"],
)
def test_a_start_imports_nothing_slow_that_it_does_not_need(start: str, slow: str) -> None:
    code = f"import sys\n{start}\nprint(*sorted({{*{slow.split()}}} & {{*sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "\n"


def test_reports_how_to_install_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.delitem(sys.modules, "kouxing.services.cli.launch.ray_workers", raising=False)
    ended = CliRunner().invoke(command_line.app, ["cluster"])
    assert isinstance(ended.exception, UserError)
    assert "pip install 'kouxing[cluster]'" in str(ended.exception)


def test_help_shows_no_python_types() -> None:
    def texts(command: Any, context: Any) -> Iterator[str]:
        for parameter in command.get_params(context):
            form = parameter.metavar
            form = parameter.display_type(context) if form is None else form
            yield f"{parameter.name}: {form}"
        for name in getattr(command, "commands", ()):
            yield from texts(command.get_command(context, name), context)

    group: Any = typer.main.get_command(command_line.app)
    context = group.context_class(group)
    group.list_commands(context)
    shown = [*texts(group, context)]
    assert "programs: NUMBER" in shown
    types = ("bool", "int", "float", "str", "path", "list")
    assert not [text for text in shown if text.partition("<")[2].startswith(types)]


@pytest.mark.parametrize("service", ["gateway", "driver"])
def test_only_a_gateway_creates_the_heads_of_the_page_before_it_starts(
    monkeypatch: pytest.MonkeyPatch, service: str
) -> None:
    steps: list[str] = []
    monkeypatch.setattr(command_line, "ensure_page_heads", lambda: steps.append("heads"))
    monkeypatch.setattr("kouxing.services.process.serve", lambda *_: steps.append("serve"))
    assert CliRunner().invoke(command_line.app, [service]).exit_code == 0
    assert steps == (["heads", "serve"] if service == "gateway" else ["serve"])
