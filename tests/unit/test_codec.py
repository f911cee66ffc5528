"""Messages are encoded and decoded; everything else is rejected with a reason for users."""

import math
from typing import Any

import msgpack
import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from kouxing_client.field_types import MAX_TEXT
from kouxing_client.messages import VERSION, Decoders, Message
from kouxing_client.messages import decode as decode_fields

from kouxing.shared.errors import Rejected
from kouxing.shared.fast_record import replace
from kouxing.shared.name_rules import NAME_RULE
from kouxing.shared.wire.codec import BadMessage, decode, encode
from kouxing.shared.wire.field_errors import describe_field_error
from kouxing.shared.wire.session import Done, Error, OpenSession
from tests.samples import SAMPLES

PHONE: dict[str, Any] = {"index": 0, "symbol": "a", "duration": 1, "final": True}
FRAME: dict[str, Any] = {"values": b"\0" * 272, "mask": b"\0" * 9}


def parts_of(kind: str, session: str = "s", **fields: object) -> list[bytes]:
    return [f"{kind}/{session}/".encode(), msgpack.packb({"session": session, **fields})]


@pytest.mark.parametrize(
    ("parts", "reason", "request_name"),
    [
        ([b"done/s/"], "parts", None),
        ([b"done", b"\x80"], "topic", None),
        ([b"dance/s/", b"\x80"], "kind", None),
        (parts_of("dance", request="r"), "kind", "r"),
        ([b"done/s/x", b"\x80"], "kind", None),
        ([b"done/s/", b"\xc1garbage"], "body", None),
        ([b"done/s/", b"\x91" * 5000], "body", None),
        (parts_of("done"), "body", None),
        (parts_of("done", request=5), "body", None),
        (parts_of("done", request="r", media_time=-1), "body", "r"),
        (parts_of("open-session", request="r", sample_rate_hz=192000), "body", "r"),
        (parts_of("open-session", request="r", encoding="mp3"), "body", "r"),
        (parts_of("open-session", session="a b", request="r"), "body", "r"),
        *((parts_of("phone", **PHONE, confidence=c), "body", None) for c in (math.nan, 1.5, -0.1)),
        (parts_of("fap-frame", values=b"short", mask=b"\0" * 9), "body", None),
        (parts_of("fap-frame", **FRAME, shapes={"arkit": b"\0" * 7}), "body", None),
        (parts_of("done", request="r", version=1), "version", "r"),
        (parts_of("open", request="r", version=1), "version", "r"),
        (parts_of("open", request="r"), "kind", "r"),
        (parts_of("done", request="r", version=0), "body", "r"),
        ([b"done/other/", msgpack.packb({"session": "s", "request": "r"})], "topic", "r"),
    ],
)
def test_rejects_bad_messages_with_a_reason_and_the_name_of_their_request(
    parts: list[bytes], reason: str, request_name: str | None
) -> None:
    with pytest.raises(BadMessage) as caught:
        decode(parts)
    assert (caught.value.reason, caught.value.request) == (reason, request_name)


def test_a_rejection_with_a_long_text_can_be_read() -> None:
    rejection = Rejected("no-service", 5000 * "文")
    error = decode(encode(Error(code=rejection.code, text=rejection.text)))
    assert isinstance(error, Error)
    assert error.text == MAX_TEXT * "文"


def test_fields_with_defaults_are_optional_and_unknown_fields_are_ignored() -> None:
    message = decode(parts_of("open-session", request="r", color="red"))
    assert message == OpenSession(session="s", request="r")


def test_clients_accept_messages_without_a_version() -> None:
    parts = parts_of("done", request="r")
    assert Decoders(Done).decode(parts) == decode(parts) == Done(session="s", request="r")
    kind, fields = decode_fields(parts) or ("", {})
    assert (kind, fields["version"], fields["request"]) == ("done", VERSION, "r")
    other = parts_of("done", request="r", version=VERSION + 1)
    assert Decoders(Done).decode(other) is None
    assert decode_fields(other) is None


@pytest.mark.parametrize(("version", "older"), [(VERSION - 1, "sender"), (VERSION + 1, "receiver")])
def test_the_rejection_of_another_version_names_both_and_the_program_to_upgrade(
    version: int, older: str
) -> None:
    with pytest.raises(BadMessage) as caught:
        decode(parts_of("status-request", version=version))
    text = str(caught.value)
    assert f"version {version}," in text
    assert f"version {VERSION}:" in text
    assert f"upgrade the {older} " in text


def test_programs_of_version_2_can_read_an_error_and_its_errors_can_be_read() -> None:
    rejection: dict[str, Any] = {"code": "bad-message", "text": "upgrade the sender"}
    _, body = encode(Error(version=2, **rejection))
    fields = msgpack.unpackb(body)
    assert fields.items() >= {"version": 2, **rejection}.items()
    assert None not in fields.values()
    received = decode(parts_of("error", **rejection, request="", retry_after_s=0.0))
    assert isinstance(received, Error)
    assert received.text == rejection["text"]


@pytest.mark.parametrize("clock_ns", [-(2**63), -1, 2**63, 2**64 - 1])
def test_heartbeats_of_a_wrong_clock_count(clock_ns: int) -> None:
    wrong = replace(SAMPLES["heartbeat"], sent_ns=clock_ns)
    assert decode(encode(wrong)) == wrong
    times = {"sent_ns": clock_ns, "received_ns": -1, "replied_ns": clock_ns}
    reply = replace(SAMPLES["heartbeat-reply"], **times)
    assert decode(encode(reply)) == reply


@given(
    st.sampled_from([*SAMPLES.values()]),
    st.sampled_from([*SAMPLES.values()]),
    st.floats(0, 1, exclude_max=True),
    st.one_of(st.binary(max_size=40), st.integers(1, 60_000).map(lambda n: b"\x81\xa1x" * n)),
)
def test_rejects_a_damaged_message_or_reads_it_the_same_twice(
    message: Message, other: Message, place: float, inserted: bytes
) -> None:
    label, body = encode(message)
    at = int(place * len(body))
    for damaged in (
        body[:at],
        body[:at] + inserted + body[at:],
        body[:at] + inserted + body[at + len(inserted) :],
        body[:at] + encode(other)[1] + body[at:],
    ):
        for topic in (label, encode(other)[0]):
            try:
                read = encode(decode([topic, damaged]))
            except BadMessage:
                continue
            assert encode(decode(read)) == read


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
