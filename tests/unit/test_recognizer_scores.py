import json
from pathlib import Path

import numpy as np
import pytest

from kouxing.corpora.scoring import align_symbols
from kouxing.evaluation.recognizer.aligned_corpus import align_corpus
from kouxing.evaluation.recognizer.disturbances import (
    change_speed,
    check_conditions,
    disturbances_for,
)
from kouxing.evaluation.recognizer.error_rates import evaluate_recognizer
from kouxing.evaluation.recognizer.synthetic_sounds import varying_noise as noise
from kouxing.evaluation.report.recognition_table import speech_table
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.search.output_rule import OutputRuleConfig
from kouxing.shared.errors import UserError
from tests.corpora import write_manifest
from tests.system import VOWELS_FILE


def test_aligns_random_strings_with_the_fewest_errors() -> None:
    """Against the recursive definition (Levenshtein 1966)."""
    rng = np.random.default_rng(0)

    def distance(a: str, b: str) -> int:
        if not a or not b:
            return len(a) + len(b)
        change = distance(a[1:], b[1:]) + (a[0] != b[0])
        return min(change, distance(a[1:], b) + 1, distance(a, b[1:]) + 1)

    for _ in range(30):
        a, b = ("".join(rng.choice(list("abc"), rng.integers(0, 6))) for _ in range(2))
        pairs = align_symbols(a, b)
        assert sum(i is None or j is None or a[i] != b[j] for i, j in pairs) == distance(a, b)


@pytest.mark.slow
def test_a_corpus_with_bad_rows_is_evaluated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "noise.wav").write_bytes(b"no sound")
    rows = [
        f"v\t{VOWELS_FILE}\tm\ttest\t2.2\t啊喔鹅衣乌迂\t",
        "none\tnone.wav\tm\ttest\t2.2\t啊\ta1",
        f"unknown\t{VOWELS_FILE}\tm\ttest\t2.2\t啊\txa1 kzo2",
        f"long\t{VOWELS_FILE}\tm\ttest\t2.2\t啊\t" + "a1 " * 90,
        f"lying\t{VOWELS_FILE}\tm\ttest\t60\t啊\t" + "bao1 " * 60,
        "broken\tnoise.wav\tm\ttest\t2.2\t啊\ta1",
        f"other\t{VOWELS_FILE}\tm\ttrain\t2.2\t啊\txa1",
    ]
    write_manifest(tmp_path, "utt_id path speaker split seconds text pinyin", rows)
    model = load_model()
    references = align_corpus(model, tmp_path, "test")
    reasons = "".join(capsys.readouterr().err.splitlines())
    assert len(references) == 1
    disturbances = disturbances_for(references, noise(1.0), ["room"])
    results = evaluate_recognizer(model, references, disturbances, OutputRuleConfig(1, 0.9))
    json.dumps(results)  # everything is plain
    table = speech_table({"blocks": results})
    assert table.title == "1 recording, 1 speaker"
    assert [row[:3] for row in table.rows] == [
        [kind, "blocks", "6"] for kind in ("clean", "room", "5.5 to 7/s")
    ]
    assert list(results["speech"]) == ["clean", "room", "5.5 to 7/s"]
    assert set(results["rules"]) == {"N = 3", "N = 3, conf. 0.99"}
    clean = results["speech"]["clean"]
    assert clean["final"]["phone_errors"]["reference"] == 6
    final = clean["final"]["phone_errors"]
    errors = final["insertions"] + final["deletions"] + final["substitutions"]
    assert results["errors_by_recording"] == {"v": {"phones": 6, "errors": errors}}
    assert clean["final"]["labials"]["recall"] is None  # no p, b, m, f in it
    assert clean == results["speech"]["5.5 to 7/s"]
    for reason in (
        "row 3 (none): no audio file",
        "row 4 (unknown): ",
        "row 5 (long): 90 phones do not fit into 2.20 s",
        "lying: 2.2",
        "noise.wav: cannot read",
        "5 rows skipped",
    ):
        assert reason in reasons
    with pytest.raises(UserError, match="'nothing'"):
        align_corpus(model, tmp_path, "nothing")
    with pytest.raises(
        UserError, match="unknown condition 'rain'; choose from: clean, noise 10 dB"
    ):
        check_conditions(["clean", "rain"])


@pytest.mark.parametrize("speed", [0.8, 2.0])
def test_a_change_of_speed_moves_sounds_to_their_new_times(speed: float) -> None:
    time_s = np.arange(32_000) / 16_000
    burst = noise(2.0) * np.exp(-(((time_s - 1.0) / 0.1) ** 2))
    power = change_speed(burst.astype(np.float32), speed) ** 2
    middle_s = float(np.sum(np.arange(len(power)) * power) / np.sum(power)) / 16_000
    assert middle_s == pytest.approx(1.0 / speed, abs=0.003)
