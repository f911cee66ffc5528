"""Discovery of lip models: built-in packages and entry points."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from kouxing.services.cli.configuration import markdown_page
from kouxing.services.lip_models import _packages, lip_models
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.errors import UserError
from kouxing.shared.face.lip_constants import DEFAULT_LIP_MODEL

PACKAGE = """
from kouxing.services.lip_models import LipModelInfo

LIP_MODEL = LipModelInfo(
    delay_ms=40.0,
    titles={"en": "toy", "zh": "toy"},
    load=lambda inventory: ("toy", inventory.language),
)
"""


@pytest.fixture(autouse=True)
def _fresh_registry() -> Iterator[None]:
    _packages.cache_clear()
    yield
    _packages.cache_clear()
    load_lip_model.cache_clear()


def install(folder: Path, package: str, code: str) -> None:
    """Write a distribution with the lip model ``toy`` to a folder."""
    (folder / f"{package}.py").write_text(code)
    metadata = folder / "toy_lips-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-lips\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(f"[kouxing.lip_models]\ntoy = {package}\n")


def test_built_in_lip_models() -> None:
    assert lip_models().keys() >= {"dynamic-visemes", "ferguson", "learned"}
    assert DEFAULT_LIP_MODEL in lip_models()
    for name, info in lip_models().items():
        assert info.titles.keys() == {"en", "zh"}
        assert SynthesizerConfig(lips=name).delay_ms == info.delay_ms


def test_a_package_adds_a_lip_model_by_entry_point(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path, "toy_lips", PACKAGE)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert lip_models()["toy"].delay_ms == 40.0
    toy: object = load_lip_model(name="toy")
    assert toy == ("toy", "mandarin")


def test_an_unknown_lip_model_is_an_error() -> None:
    with pytest.raises(UserError, match="unknown lip model 'muscles'; use one of dynamic-visemes"):
        load_lip_model(name="muscles")


def test_a_broken_package_spoils_no_other_lip_model_nor_the_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path, "broken_lips", "raise ImportError('no muscles')")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert SynthesizerConfig(lips="ferguson").delay_ms == 160.0
    assert "| `lips` |" in markdown_page()
    with pytest.raises(UserError, match=r"cannot import the lip model toy .* no muscles"):
        load_lip_model(name="toy")
