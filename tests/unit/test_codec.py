from __future__ import annotations

import msgpack
import pytest

from kouxing.shared.wire.audio import AudioChunk
from kouxing.shared.wire.codec import BadMessage, decode, encode, topic
from kouxing.shared.wire.face import FapFrame
from kouxing.shared.wire.session import Done, OpenSession

pytestmark = pytest.mark.unit


def parts_of(kind: str, session: str = "s", **fields: object) -> list[bytes]:
    return [f"{kind}/{session}/".encode(), msgpack.packb({"session": session, **fields})]


def test_topics_end_in_a_slash() -> None:
    assert topic(FapFrame, "demo") == b"fap-frame/demo/"


def test_fields_with_defaults_are_optional() -> None:
    message = decode(parts_of("open-session", request="r"))
    assert message == OpenSession(session="s", request="r")


def test_unknown_fields_are_ignored() -> None:
    assert decode(parts_of("done", request="r", colour="red")) == Done(session="s", request="r")


@pytest.mark.parametrize(
    ("parts", "reason"),
    [
        ([b"done/s/"], "parts"),
        ([b"done/s/", b"", b""], "parts"),
        ([b"done", b"\x80"], "topic"),
        ([b"\xff\xfe/s/", b"\x80"], "topic"),
        ([b"dance/s/", b"\x80"], "kind"),
        ([b"done/s/x", b"\x80"], "kind"),
        ([b"done/s/", b"\xc1garbage"], "body"),
        ([b"done/s/", b""], "body"),
        ([b"done/s/", b"\x91" * 5000], "body"),
        (parts_of("done"), "body"),
        (parts_of("done", request=5), "body"),
        (parts_of("done", request=""), "body"),
        (parts_of("done", request="r", media_time=-1), "body"),
        (parts_of("open-session", request="r", sample_rate_hz=192000), "body"),
        (parts_of("open-session", request="r", encoding="mp3"), "body"),
        (parts_of("open-session", session="a b", request="r"), "body"),
        (parts_of("fap-frame", values=b"short", mask=b"\0" * 9), "body"),
        (parts_of("done", request="r", version=1), "version"),
        (parts_of("done", version=1, other=1), "version"),
        (parts_of("open", request="r", version=1), "version"),
        (parts_of("open", request="r"), "kind"),
        (parts_of("done", request="r", version=0), "body"),
        (parts_of("done", request="r", version="1"), "body"),
        ([b"done/other/", msgpack.packb({"session": "s", "request": "r"})], "topic"),
    ],
)
def test_rejects_bad_messages_with_a_reason(parts: list[bytes], reason: str) -> None:
    with pytest.raises(BadMessage) as caught:
        decode(parts)
    assert caught.value.reason == reason


@pytest.mark.parametrize("version", [1, 2, 65535])
def test_rejects_another_version_and_says_what_to_do(version: int) -> None:
    with pytest.raises(BadMessage, match="upgrade the sender") as caught:
        decode(parts_of("open", request="r", version=version))
    assert caught.value.version == version
    assert f"'open' is a message of protocol version {version}" in str(caught.value)
    assert "proto/PROTOCOL.md" in str(caught.value)


@pytest.mark.parametrize("confidence", [float("nan"), 1.5, -0.1, float("inf")])
def test_rejects_a_confidence_outside_0_to_1(confidence: float) -> None:
    with pytest.raises(BadMessage):
        decode(
            parts_of("phone", index=0, symbol="a", duration=1, confidence=confidence, final=True)
        )


def test_binary_fields_are_binary_in_msgpack() -> None:
    _, body = encode(AudioChunk(session="s", token="t", pcm=b"\x01\x02"))
    assert msgpack.unpackb(body)["pcm"] == b"\x01\x02"
