import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from kouxing.corpora.scoring import matched_pairs
from kouxing.evaluation.recognizer.error_rates import evaluate_recognizer
from kouxing.evaluation.recognizer.report import draw_delay_curve, print_figures
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.search.output_rule import OutputRuleConfig
from kouxing.shared.errors import UserError
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
        pairs = matched_pairs(a, b)
        assert sum(i is None or j is None or a[i] != b[j] for i, j in pairs) == distance(a, b)


@pytest.mark.slow
def test_evaluates_a_corpus_with_bad_rows(tmp_path: Path) -> None:
    vowels = VOWELS_FILE
    (tmp_path / "noise.wav").write_bytes(b"no sound")
    rows = [
        f"v\t{vowels}\tm\ttest\t2.2\t啊喔鹅衣乌迂\t",
        "none\tnone.wav\tm\ttest\t2.2\t啊\ta1",
        f"unknown\t{vowels}\tm\ttest\t2.2\t啊\txa1 kzo2",
        f"long\t{vowels}\tm\ttest\t2.2\t啊\t" + "a1 " * 90,
        f"lying\t{vowels}\tm\ttest\t60\t啊\t" + "bao1 " * 60,
        "broken\tnoise.wav\tm\ttest\t2.2\t啊\ta1",
        f"other\t{vowels}\tm\ttrain\t2.2\t啊\txa1",
    ]
    header = "utt_id\tpath\tspeaker\tsplit\tseconds\ttext\tpinyin"
    (tmp_path / "manifest.tsv").write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    default, *rules = (OutputRuleConfig(*each) for each in ((1, 0.9), (3, 0.0), (1, 0.7)))
    results = evaluate_recognizer(load_model(), tmp_path, "test", default, rules=rules)
    assert results["recordings"] == 1
    assert "noise.wav: cannot read" in str(results["bad_rows"])
    json.dumps(results)  # everything is plain
    named = [{"acoustic": name, **results} for name in ("one", "one", "two")]
    draw_delay_curve(named, tmp_path / "curve.png")
    assert (tmp_path / "curve.png").stat().st_size > 10_000
    with (tmp_path / "out.txt").open("w") as file:
        console = Console(width=200, record=True, file=file)
        print_figures({"one": results, "two": results}, console)
    text = console.export_text()
    reasons = (
        "row 3 (none): no audio file",
        "row 4 (unknown): ",
        "row 5 (long): 90 phones do not fit into 2.20 s",
        "lying: 2.2",
        "noise.wav: cannot read",
        "5 rows skipped",
    )
    for part in ("offline decoding", "p, b, m and f", *reasons):
        assert part in text, part
    assert "final hypothesis" in text  # side by side
    assert text.count("lying") == 1  # once, not once a model
    with pytest.raises(UserError, match="'nothing'"):
        evaluate_recognizer(load_model(), tmp_path, "nothing", default)
