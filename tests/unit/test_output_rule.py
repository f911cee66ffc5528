"""The confidence that the output rule requires; property tests compare it with the paper."""

import pytest

from kouxing.services.recognizer.search.output_rule import OutputRule, OutputRuleConfig

pytestmark = pytest.mark.unit


def test_frames_with_low_confidence_do_not_count() -> None:
    rule = OutputRule(OutputRuleConfig(2, 0.7), last_emitted=0)
    frames = [(1, 0.9), (1, 0.6), (1, 0.8), (1, 0.7), (2, 0.9), (3, 0.9), (3, 0.9)]
    assert [frame for frame, scored in enumerate(frames) if rule.update(*scored)] == [3, 6]


def test_rejects_zero_stable_frames() -> None:
    with pytest.raises(ValueError, match="num_stable_frames is 0"):
        OutputRule(OutputRuleConfig(0, 0.0), last_emitted=0)
