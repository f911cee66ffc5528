import pytest

from kouxing.services.recognizer.search.output_rule import OutputRule, OutputRuleConfig

pytestmark = pytest.mark.unit


def put_out(frames: str, num_stable_frames: int, before: str = "-") -> list[tuple[int, str]]:
    """Which letters of a string of last phones are emitted, and at which frame."""
    rule = OutputRule(OutputRuleConfig(num_stable_frames, 0.0), last_emitted=ord(before))
    return [(t, phone) for t, phone in enumerate(frames) if rule.update(ord(phone), 0.5)]


def test_put_out_at_the_third_agreeing_frame() -> None:
    assert put_out("aaaaabbbbb", 3) == [(2, "a"), (7, "b")]


def test_disagreement_starts_the_count_again() -> None:
    assert put_out("aababbb", 3) == [(6, "b")]


def test_short_units_are_dropped_by_a_large_agreement() -> None:
    assert put_out("aaaabbcccc", 2) == [(1, "a"), (5, "b"), (7, "c")]
    assert put_out("aaaabbcccc", 3) == [(2, "a"), (8, "c")]


def test_the_unit_last_put_out_is_not_repeated() -> None:
    assert put_out("aaabbaaa", 3) == [(2, "a")]  # the two frames of b did not agree long enough


def test_one_frame_suffices_for_agreement_one() -> None:
    assert put_out("abba", 1) == [(0, "a"), (1, "b"), (3, "a")]


def test_silence_before_speech_is_not_put_out() -> None:
    assert put_out("----aaa", 3) == [(6, "a")]


def test_reset_forgets() -> None:
    rule = OutputRule(OutputRuleConfig(2, 0.0), last_emitted=0)
    assert [rule.update(1, 1.0), rule.update(1, 1.0)] == [False, True]
    rule.reset()
    assert [rule.update(1, 1.0), rule.update(1, 1.0)] == [False, True]


def test_agreement_must_be_positive() -> None:
    with pytest.raises(ValueError, match="num_stable_frames is 0"):
        OutputRule(OutputRuleConfig(0, 0.0), last_emitted=0)


def test_unsure_frames_do_not_count() -> None:
    rule = OutputRule(OutputRuleConfig(2, 0.7), last_emitted=0)
    frames = [(1, 0.9), (1, 0.6), (1, 0.8), (1, 0.7), (2, 0.9), (3, 0.9), (3, 0.9)]
    assert [rule.update(phone, confidence) for phone, confidence in frames] == [
        False, False, False, True, False, False, True,
    ]  # fmt: skip
