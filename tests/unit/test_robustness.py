"""Disturbances have the stated amount, and the figures count recognized phones."""

import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from kouxing.evaluation.recognizer import robustness
from kouxing.evaluation.recognizer.disturbances import SPEECH_CONDITIONS
from kouxing.evaluation.recognizer.robustness import evaluate_robustness, print_robustness
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.search.output_rule import OutputRuleConfig
from kouxing.shared.errors import UserError

DEMO = Path(__file__).parents[2] / "shared" / "demo"


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
