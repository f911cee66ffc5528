"""What the console of ``kouxing run`` shows of a service's log."""

import json

import pytest

from kouxing.services.cli.supervisor import _console_text


@pytest.mark.parametrize(
    ("entry", "text"),
    [
        ({"level": "info", "message": "opened", "session": "s1"}, ""),
        ({"level": "warning", "message": "slow"}, "slow"),
        ({"level": "warning", "message": "slow", "session": "s1"}, "session 's1': slow"),
        ({"level": "warning", "message": "'s1' is slow", "session": "s1"}, "'s1' is slow"),
    ],
)
def test_a_warning_names_its_session(entry: dict[str, str], text: str) -> None:
    assert _console_text(json.dumps(entry).encode()) == text


def test_other_text_is_shown_as_it_is() -> None:
    assert _console_text(b"Segmentation fault\n") == "Segmentation fault"
