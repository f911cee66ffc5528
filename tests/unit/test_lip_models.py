"""Discovery of lip models: built-in packages and entry points."""

import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from kouxing.services.cli.configuration import markdown_page
from kouxing.services.lip_models import ENTRY_POINTS, _packages, lip_models
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.face_animator import FaceAnimator
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.errors import UserError
from kouxing.shared.face.lip_constants import DEFAULT_LIP_MODEL
from kouxing.shared.phones.events import Progress, SoundEvent
from kouxing.shared.plugins import plugins
from tests.documents import code_blocks
from tests.lips import phone
from tests.system import ROOT

GUIDE = ROOT / "docs" / "extending.md"
WRONG_LOAD = """
from kouxing.services.lip_models import LipModelInfo

LIP_MODEL = LipModelInfo(delay_ms=40.0, titles={"en": "toy", "zh": "toy"}, load=lambda _: object())
"""


@pytest.fixture(autouse=True)
def _fresh_registry() -> Iterator[None]:
    caches = plugins, _packages, load_lip_model
    for cached in caches:
        cached.cache_clear()
    yield
    for cached in caches:
        cached.cache_clear()


def install(folder: Path, package: str, code: str) -> None:
    """Write a distribution with the lip model ``toy`` to a folder."""
    (folder / f"{package}.py").write_text(code, encoding="utf-8")
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


def test_the_lip_model_of_the_guide_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (code,), (project,) = (code_blocks(GUIDE, kind) for kind in ("python", "toml"))
    (entry,) = tomllib.loads(project)["project"]["entry-points"][ENTRY_POINTS].items()
    assert entry == ("my-lips", "my_lips")
    install(tmp_path, "my_lips", code)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert lip_models()["toy"].delay_ms == 100.0
    face = FaceAnimator(load_lip_model(name="toy"), frame_rate_hz=50.0, delay_s=0.1)

    def jaw_after(event: SoundEvent) -> list[float]:
        return [float(faps[2]) for _, faps in face.process(event)]

    face.process(phone(0, "a", 0.5, 0.5))
    jaw = jaw_after(Progress(time_s=2.0, level_db=-20.0))
    assert max(jaw[:25]) == 0.0  # before the vowel
    assert max(jaw[25:50]) == pytest.approx(300.0, abs=30.0)
    assert jaw[-1] < 1.0


@pytest.mark.parametrize(
    ("code", "error"),
    [
        ("raise ImportError('no muscles')", "cannot import the lip model toy .* no muscles"),
        ("1 / 0", "cannot import the lip model toy .* division by zero"),
        ("LIP_MODEL = 3", r"lip model toy \(package .*\): LIP_MODEL is not a LipModelInfo"),
        (WRONG_LOAD, "lip model toy: load returned object, which is not a LipModel"),
        (WRONG_LOAD.replace("object()", "{}['jaw']"), "cannot load the lip model toy .*KeyError"),
    ],
)
def test_faulty_package_does_not_affect_other_lip_models_or_the_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, error: str
) -> None:
    install(tmp_path, "faulty_lips", code)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "faulty_lips", raising=False)
    assert SynthesizerConfig(lips="ferguson").delay_ms == 160.0
    assert "| `lips` |" in markdown_page()
    assert DEFAULT_LIP_MODEL in lip_models()
    with pytest.raises(UserError, match=error):
        load_lip_model(name="toy")
