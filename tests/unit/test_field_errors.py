"""Errors about fields of messages are sentences for users."""

from typing import Any

import msgspec
import pytest

from kouxing.shared.name_rules import NAME_RULE
from kouxing.shared.wire.field_errors import describe_field_error
from kouxing.shared.wire.session import OpenSession


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"sample_rate_hz": 200000}, "sample_rate_hz must be an integer of at most 48000"),
        ({"sample_rate_hz": "x"}, "sample_rate_hz must be an integer, not a string"),
        ({"session": "a b"}, f"session is not a valid name; {NAME_RULE}"),
        ({"session": "a\n"}, f"session is not a valid name; {NAME_RULE}"),
        ({"encoding": "s16le\n"}, "encoding must be s16le or f32le"),
        ({"encoding": "mp3"}, "encoding must be s16le or f32le"),
        ({"face": {"feeling": -1}}, "face.feeling must be a number of at least 0.0"),
        ({"face": {"shapes": 17 * ["x"]}}, "face.shapes must be a list of at most 16 items"),
        ({"mouth_profile": 5}, "mouth_profile must be binary data, not an integer"),
        ({"mouth_profile": "?"}, "mouth_profile: Invalid base64 encoded string"),
        ({"language": 5}, "language must be a string, not an integer"),
    ],
)
def test_names_the_field_and_its_rule(fields: dict[str, Any], text: str) -> None:
    with pytest.raises(msgspec.ValidationError) as caught:
        msgspec.convert({"request": "r", **fields}, OpenSession)
    assert describe_field_error(caught.value) == text


def test_other_errors_keep_their_text() -> None:
    assert describe_field_error(ValueError("no message")) == "no message"
