"""Commands refuse options that have no effect, and names of files that they would overwrite."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from kouxing.services.cli.main import app
from kouxing.shared.errors import UserError


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("speak a.wav --rate 8000", "--rate and --channels apply to raw samples; add --raw"),
        ("speak a.wav --raw --track 2", "--track does not apply to raw samples"),
        ("speak a.wav --device USB", "--device applies to mic and monitor"),
        ("speak mic --fast", "--fast does not apply to mic"),
        ("speak monitor --raw", "do not apply to monitor"),
        ("lips a.wav mouth.svg --points 5", "--points applies to .csv"),
        ("lips a.wav mouth.png --smooth", "--smooth applies to .mp4 and .csv"),
        ("lips a.wav mouth.png --timing align", "--timing needs a text"),
        ("listen --show phones --as arkit", "cannot be combined with --output or --as"),
        ("express demo --hold 2", "--hold needs an expression"),
        ("run --stop-after", "need a file: kouxing run --play"),
        ("run --track 2", "need a file: kouxing run --play"),
        ("config control --markdown", "leave out the service"),
        ("head export heads --all --head ada", "leave out --head or --all"),
        ("keys add tablet", "tablet.key exists; add --force"),
        ("evaluate schemes --anchor", "add --videos FOLDER"),
        ("evaluate schemes --split dev", "add --manifest"),
        ("train phone-lm -o lm.npz --words 9", "--words applies to sampled words"),
    ],
)
def test_refuses_an_option_without_effect(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: str, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a.wav").touch()
    Path("tablet.key").touch()
    error = CliRunner().invoke(app, arguments.split()).exception
    assert isinstance(error, UserError), error
    assert message in str(error)
