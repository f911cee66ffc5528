"""When phones are emitted, on strings of last phones; letters stand for phones."""

import pytest

from kouxing.services.recognizer.search.output_rule import OutputRule, OutputRuleConfig

pytestmark = pytest.mark.unit


@pytest.mark.parametrize(
    ("frames", "num_stable_frames", "emitted"),
    [
        ("aaaaabbbbb", 3, [(2, "a"), (7, "b")]),  # at the third frame that agrees
        ("aababbb", 3, [(6, "b")]),  # disagreement restarts the count
        ("aaaabbcccc", 2, [(1, "a"), (5, "b"), (7, "c")]),
        ("aaaabbcccc", 3, [(2, "a"), (8, "c")]),  # short phones are dropped
        ("aaabbaaa", 3, [(2, "a")]),  # the last emitted phone is not repeated
        ("abba", 1, [(0, "a"), (1, "b"), (3, "a")]),
        ("----aaa", 3, [(6, "a")]),  # silence before speech is not emitted
    ],
)
def test_emits_phones_that_are_stable(
    frames: str, num_stable_frames: int, emitted: list[tuple[int, str]]
) -> None:
    rule = OutputRule(OutputRuleConfig(num_stable_frames, 0.0), last_emitted=ord("-"))
    for _ in range(2):
        assert [(t, phone) for t, phone in enumerate(frames) if rule.update(ord(phone), 0.5)] == (
            emitted
        )
        rule.reset()


def test_frames_with_low_confidence_do_not_count() -> None:
    rule = OutputRule(OutputRuleConfig(2, 0.7), last_emitted=0)
    frames = [(1, 0.9), (1, 0.6), (1, 0.8), (1, 0.7), (2, 0.9), (3, 0.9), (3, 0.9)]
    assert [frame for frame, scored in enumerate(frames) if rule.update(*scored)] == [3, 6]


def test_rejects_zero_stable_frames() -> None:
    with pytest.raises(ValueError, match="num_stable_frames is 0"):
        OutputRule(OutputRuleConfig(0, 0.0), last_emitted=0)
