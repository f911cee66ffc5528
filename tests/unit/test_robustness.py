"""Disturbances have the stated amount, and the figures count recognized phones."""

import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from kouxing.evaluation.recognizer import robustness
from kouxing.evaluation.recognizer.disturbances import (
    SOUNDS,
    SPEECH_CONDITIONS,
    add_echoes,
    change_speed,
)
from kouxing.evaluation.recognizer.robustness import evaluate_robustness, print_robustness
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.search.output_rule import OutputRuleConfig
from kouxing.shared.errors import UserError

DEMO = Path(__file__).parents[2] / "shared" / "demo"
RATE_HZ = 16_000


def tone(frequency_hz: float) -> np.ndarray:
    time_s = np.arange(RATE_HZ) / RATE_HZ
    return (0.3 * np.sin(2 * np.pi * frequency_hz * time_s)).astype(np.float32)


def level(samples: np.ndarray) -> float:
    return float(np.sqrt(np.mean(samples.astype(np.float64) ** 2)))


def test_echoes_last_half_a_second() -> None:
    click = np.zeros(RATE_HZ, np.float32)
    click[0] = 1
    heard = add_echoes(click)
    assert heard[0] == pytest.approx(np.sqrt(1 / 2), rel=0.1)
    falls = level(heard[1:801]) / level(heard[4001:4801])
    assert 20 * np.log10(falls) == pytest.approx(30, abs=2)  # in a quarter of a second
    assert np.abs(heard[8000:]).max() < 1e-6


@pytest.mark.parametrize("factor", [0.8, 1.0, 1.3])
def test_speed_changes_at_constant_pitch(factor: float) -> None:
    changed = change_speed(tone(200), factor)
    assert len(changed) == pytest.approx(RATE_HZ / factor, abs=200)
    middle = changed[2000:10_000]
    spectrum = np.abs(np.fft.rfft(middle * np.hanning(len(middle))))
    assert np.fft.rfftfreq(len(middle), 1 / RATE_HZ)[spectrum.argmax()] == pytest.approx(200, abs=4)


@pytest.mark.parametrize("name", SOUNDS)
def test_sounds_are_reproducible(name: str) -> None:
    sound = SOUNDS[name](1.5)
    assert sound.shape == (24_000,)
    assert 0.02 < level(sound) <= 0.06
    np.testing.assert_array_equal(sound, SOUNDS[name](1.5))


@pytest.mark.slow
def test_evaluates_a_small_corpus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = "utt_id\tpath\tspeaker\tsplit\tseconds\tpinyin\n"
    (tmp_path / "manifest.tsv").write_text(
        f"{rows}one\t{DEMO / 'hello-male.wav'}\tm\tdev\t3\tni3 hao3\n", encoding="utf-8"
    )
    conditions = {name: SPEECH_CONDITIONS[name] for name in ("as recorded", "half level")}
    monkeypatch.setattr(robustness, "SPEECH_CONDITIONS", conditions)
    monkeypatch.setattr(robustness, "SOUNDS", {"noise": lambda _: np.zeros(16_000, np.float32)})
    other = tmp_path / "other"
    other.mkdir()
    (other / "hello.wav").symlink_to(DEMO / "hello-male.wav")
    figures = evaluate_robustness(
        load_model(), tmp_path, "dev", OutputRuleConfig(1, 0.9), other_language=other
    )
    assert set(figures["speech"]) == {*conditions, "babble 10 dB below"}
    rates = figures["speech"]["as recorded"]["offline"]
    assert rates["phone_error_rate"] > 0 < rates["viseme_error_rate"]  # the text is too short
    assert rates["labials"]["recall"] is None  # no p, b, m, f in it
    assert figures["sounds"]["noise"] == 0
    assert figures["sounds"]["other language"] > 60
    output = io.StringIO()
    print_robustness({"a model": figures}, Console(file=output, width=120))
    assert "half level" in output.getvalue()
    with pytest.raises(UserError, match="no usable recordings in the split 'test'"):
        evaluate_robustness(load_model(), tmp_path, "test", OutputRuleConfig())


def test_rejects_a_folder_without_recordings(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="contains no wav"):
        robustness.read_recordings(tmp_path)
