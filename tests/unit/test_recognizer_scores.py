from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from evaluation.recognizer import (
    ErrorCounts,
    bootstrap_interval,
    count_errors,
    evaluate_recognizer,
    matched_pairs,
    most_confused,
    mouth_shapes,
    print_scores,
)
from services.recognizer.load import load_model
from shared.errors import UserError
from shared.phones import UNIT_INDEX, UNITS

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
    low, high = bootstrap_interval(mixed, rng)
    assert 0.2 < low < 0.45 < high < 0.7


def test_confusions_are_ranked() -> None:
    confusion = np.zeros((len(UNITS), len(UNITS)), np.int64)
    confusion[UNIT_INDEX["in"], UNIT_INDEX["ing"]] = 4
    confusion[UNIT_INDEX["a"], UNIT_INDEX["a"]] = 99
    first = most_confused(confusion)[0]
    assert first == {"said": "in", "heard": "ing", "times": 4}


def test_a_whole_evaluation(tmp_path: Path) -> None:
    (tmp_path / "manifest.tsv").write_text(
        "utt_id\tpath\tspeaker\tsplit\tseconds\ttext\tpinyin\n"
        f"v\t{DEMO / 'vowels-male.wav'}\tm\ttest\t2.2\t啊喔鹅衣乌迂\t\n",
        encoding="utf-8",
    )
    picture = tmp_path / "confusions.png"
    results = evaluate_recognizer(
        load_model(), tmp_path, "test", rules=[(3, 0.0)], confusion_picture=picture
    )
    assert picture.stat().st_size > 10_000
    console = Console(width=160, record=True, file=(tmp_path / "out.txt").open("w"))
    print_scores(results, console)
    assert "full traceback" in console.export_text()
    console.file.close()
    with pytest.raises(UserError, match="'nothing'"):
        evaluate_recognizer(load_model(), tmp_path, "nothing")
