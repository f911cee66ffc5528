import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from evaluation.recognizer import (
    ErrorCounts,
    bootstrap_interval,
    count_errors,
    evaluate_recognizer,
    first_said,
    matched_pairs,
    most_confused,
    mouth_shapes,
)
from evaluation.recognizer_report import draw_confusions, print_figures
from services.recognizer.load import load_model
from shared.errors import UserError
from shared.phones import UNIT_INDEX, UNITS, Phone, SpeechChange

pytestmark = pytest.mark.unit

DEMO = Path(__file__).parents[2] / "shared" / "demo"


@pytest.mark.parametrize(
    ("said", "heard", "errors"),
    [
        ("n i h ao", "n i h ao", (0, 0, 0)),
        ("n i h ao", "n i h a", (0, 0, 1)),
        ("n i h ao", "n h ao", (0, 1, 0)),
        ("n i h ao", "n i sh h ao", (1, 0, 0)),
        ("n i", "", (0, 2, 0)),
        ("", "n i", (2, 0, 0)),
    ],
)
def test_errors(said: str, heard: str, errors: tuple[int, int, int]) -> None:
    counts = count_errors(said.split(), heard.split())
    assert (counts.insertions, counts.deletions, counts.substitutions) == errors


def test_what_is_said_first_and_what_revises_it() -> None:
    def say(index: int, unit: str, final: bool = False) -> Phone:
        return Phone(
            index=index, unit=unit, onset_s=0.0, duration_s=0.1, confidence=1.0, final=final
        )

    known: set[int] = set()
    chunks: list[list[Phone | SpeechChange]] = [
        [SpeechChange(active=True, time_s=0.0), say(0, "n")],
        [say(0, "l")],  # put out in the place of the one before
        [say(0, "n"), say(1, "i"), say(2, "h")],  # a correction, one passed over, one put out
        [say(0, "n", True), say(2, "x"), say(3, "ao"), say(3, "ou", True)],
    ]
    heard = [[phone.unit for phone in first_said(chunk, known)] for chunk in chunks]
    assert heard == [["n"], ["l"], ["i", "h"], ["ao"]]
    assert known == {0, 1, 2, 3}


def test_rate_and_sum() -> None:
    one = ErrorCounts(insertions=1, deletions=2, substitutions=3, reference=10)
    assert one.rate == 0.6
    assert (one + one).rate == 0.6
    assert (one + ErrorCounts(reference=10)).rate == 0.3


def test_fewest_errors_for_random_strings() -> None:
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


def test_shapes_of_the_mouth() -> None:
    assert mouth_shapes(["b", "iao"]) == ["b", "i", "ao"]
    assert mouth_shapes(["sh", "iii"]) == ["zh"]  # the vowel holds the shape
    assert mouth_shapes(["p", "a", "sil", "m", "ang"]) == ["b", "a", "b", "a"]


def test_interval_holds_the_rate_and_closes_for_equal_speakers() -> None:
    rng = np.random.default_rng(0)
    same = [ErrorCounts(substitutions=3, reference=10)] * 5
    assert bootstrap_interval(same, rng) == (0.3, 0.3)
    mixed = [ErrorCounts(substitutions=k, reference=10) for k in range(10)]
    bounds = bootstrap_interval(mixed, rng)
    assert bounds is not None
    low, high = bounds
    assert 0.2 < low < 0.45 < high < 0.7
    assert bootstrap_interval(mixed[:1], rng) is None  # one speaker says nothing about others


def test_confusions_are_ranked() -> None:
    confusion = np.zeros((len(UNITS), len(UNITS)), np.int64)
    confusion[UNIT_INDEX["in"], UNIT_INDEX["ing"]] = 4
    confusion[UNIT_INDEX["a"], UNIT_INDEX["a"]] = 99
    first = most_confused(confusion)[0]
    assert first == {"said": "in", "heard": "ing", "times": 4}


def test_a_whole_evaluation_with_bad_rows(tmp_path: Path) -> None:
    vowels = DEMO / "vowels-male.wav"
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
    rules = [(3, 0.0), (1, 0.7)]
    results = evaluate_recognizer(load_model(), tmp_path, "test", rules=rules)
    assert results["recordings"] == 1
    assert results["num_bad_rows"] == 5
    json.dumps(results)  # everything is plain
    picture = tmp_path / "confusions.png"
    draw_confusions(results, picture)
    assert picture.stat().st_size > 10_000
    with (tmp_path / "out.txt").open("w") as file:
        console = Console(width=200, record=True, file=file)
        print_figures({"one": results, "two": results}, console)
    text = console.export_text()
    reasons = (
        "row 3 (none): no audio file",
        "row 4 (unknown): unknown pinyin syllable",
        "row 5 (long): 90 units cannot be said in 2.20 s",
        "lying: 2.2",
        "broken: cannot read",
        "5 rows skipped",
    )
    for part in ("full traceback", "by speaker", "CPU seconds", "side by side", *reasons):
        assert part in text, part
    assert text.count("lying") == 1  # once, not once a model
    with pytest.raises(UserError, match="'nothing'"):
        evaluate_recognizer(load_model(), tmp_path, "nothing")
