import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from kouxing.corpora.scoring import ErrorCounts, count_errors, matched_pairs
from kouxing.evaluation.recognizer.error_rates import (
    bootstrap_interval,
    evaluate_recognizer,
    mouth_shapes,
)
from kouxing.evaluation.recognizer.labials import Labials
from kouxing.evaluation.recognizer.report import draw_delay_curve, print_figures
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.search.output_rule import OutputRuleConfig
from kouxing.shared.errors import UserError
from tests.languages import MANDARIN
from tests.system import VOWELS_FILE

DEMO = Path(__file__).parents[2] / "shared" / "demo"


@pytest.mark.parametrize(
    ("reference", "recognized", "errors"),
    [
        ("n i h ao", "n h a", (0, 1, 1)),
        ("n i h ao", "n i sh h ao", (1, 0, 0)),
        ("n i", "", (0, 2, 0)),
    ],
)
def test_errors(reference: str, recognized: str, errors: tuple[int, int, int]) -> None:
    counts = count_errors(reference.split(), recognized.split())
    assert (counts.insertions, counts.deletions, counts.substitutions) == errors


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


def test_mouth_shapes() -> None:
    assert mouth_shapes(["b", "iao"], MANDARIN) == ["b", "i", "ao"]
    assert mouth_shapes(["sh", "iii"], MANDARIN) == ["zh"]  # the vowel keeps the shape
    assert mouth_shapes(["p", "a", "sil", "m", "ang"], MANDARIN) == ["b", "a", "b", "a"]


def test_bootstrap_interval() -> None:
    rng = np.random.default_rng(0)
    same = [ErrorCounts(substitutions=3, reference=10)] * 5
    assert bootstrap_interval(same, rng) == (0.3, 0.3)
    mixed = [ErrorCounts(substitutions=k, reference=10) for k in range(10)]
    bounds = bootstrap_interval(mixed, rng)
    assert bounds is not None
    low, high = bounds
    assert 0.2 < low < 0.45 < high < 0.7
    assert bootstrap_interval(mixed[:1], rng) is None  # one speaker gives no interval


def test_recall_and_precision_of_labials() -> None:
    labials = Labials(MANDARIN)
    assert labials.rates() == {"recall": None, "precision": None}
    labials.add(["p", "a", "m", "i", "f", "u"], ["t", "a", "b", "i", "f", "u"])
    labials.add(["b", "a"], ["a"])
    labials.add(["d", "a", "a"], ["b", "a", "m", "a"])
    assert labials.rates() == {"recall": 2 / 4, "precision": 2 / 4}


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
    assert "broken: cannot read" in str(results["bad_rows"])
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
        "broken: cannot read",
        "5 rows skipped",
    )
    for part in ("offline decoding", "p, b, m and f", *reasons):
        assert part in text, part
    assert "final hypothesis" in text  # side by side
    assert text.count("lying") == 1  # once, not once a model
    with pytest.raises(UserError, match="'nothing'"):
        evaluate_recognizer(load_model(), tmp_path, "nothing", default)
