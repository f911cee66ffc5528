"""A tracker's packets with the mouth of the sound."""

import errno
import struct
from unittest import mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kouxing.services.senders.connection import DatagramConnection
from kouxing.services.senders.live_link import LiveLinkConnection
from kouxing.services.senders.osc import bundle_messages, encode_message
from kouxing.services.senders.protocols import make_connection, parse_target
from kouxing.services.senders.tracker_input import TrackerInput
from kouxing.shared.errors import UserError
from tests.fake_time import with_fake_time
from tests.receivers import LIVE_LINK_ORDER, frame_of, read_live_link, read_osc


def connection_to(url: str) -> DatagramConnection:
    connection = make_connection(parse_target(url))
    assert isinstance(connection, DatagramConnection)
    return connection


MOUTH_FRAME = frame_of(jawOpen=0.6)
VMC = connection_to("vmc://?shapes=arkit&camera=39541")
LIVE_LINK = LiveLinkConnection(parse_target("livelink://?camera=11112"))


def test_vmc_keeps_everything_but_the_mouth() -> None:
    bone = ("Head", 0.0, 1.5, 0.0, 0.0, 0.1, 0.0, 0.99)
    sent = [
        encode_message("/VMC/Ext/T", 3.5),
        encode_message("/VMC/Ext/Bone/Pos", *bone),
        encode_message("/VMC/Ext/Blend/Val", "A", 0.9),
        encode_message("/VMC/Ext/Blend/Val", "JawOpen", 0.9),
        encode_message("/VMC/Ext/Blend/Val", "Blink_L", 0.25),
        encode_message("/VMC/Ext/Blend/Val", "browInnerUp", 0.5),
        encode_message("/VMC/Ext/Blend/Apply"),
        encode_message("/VMC/Ext/OK", 1),
    ]
    for packets in (list(bundle_messages(sent)), sent):  # in bundles, or one by one
        answers = [VMC.with_mouth(packet, MOUTH_FRAME) for packet in packets]
        messages = [parsed for passed, _ in answers for parsed in read_osc(list(passed)) if passed]
        assert any(has_mouth for _, has_mouth in answers)
        values = {args[0]: args[1] for address, args in messages if address.endswith("/Val")}
        assert values["jawOpen"] == values["JawOpen"] == pytest.approx(0.6, abs=0.05)
        assert "A" not in values  # a model with both would open its mouth twice
        assert (values["Blink_L"], values["browInnerUp"]) == (0.25, 0.5)
        others = [item for item in messages if not item[0].startswith("/VMC/Ext/Blend")]
        assert others[0] == ("/VMC/Ext/T", [3.5])
        assert others[1][1] == pytest.approx([*bone])
        assert [address for address, _ in messages][-2:] == ["/VMC/Ext/Blend/Apply", "/VMC/Ext/OK"]


def test_a_tracker_without_shapes_does_not_replace_the_session() -> None:
    (packet,) = bundle_messages(
        [encode_message("/VMC/Ext/Bone/Pos", "Hips", 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)]
    )
    packets, has_mouth = VMC.with_mouth(packet, MOUTH_FRAME)
    assert list(packets) == [packet]
    assert not has_mouth


def test_a_message_larger_than_a_datagram_is_alone_in_a_bundle() -> None:
    large, small = encode_message("/long", "x" * 2000), encode_message("/short", 1)
    assert [b"/long" in bundle for bundle in bundle_messages([large, small])] == [True, False]


def test_live_link_keeps_everything_but_the_mouth() -> None:
    tracked = frame_of(jawOpen=0.1, eyeBlinkLeft=0.4, mouthSmileLeft=0.8)
    tracked.faps[48] = 0.2e5  # the head's yaw
    packet = LiveLinkConnection(parse_target("livelink://?name=Phone")).encode_at(tracked, 12.0)
    (changed,), has_mouth = LIVE_LINK.with_mouth(packet, MOUTH_FRAME)
    before, after = read_live_link(packet), read_live_link(changed)
    assert has_mouth
    assert {**before, "values": ()} == {**after, "values": ()}
    spoken = MOUTH_FRAME.weights("arkit")
    for name, old, new in zip(LIVE_LINK_ORDER, before["values"], after["values"], strict=False):
        is_mouth = name.startswith(("jaw", "mouth", "tongue", "cheekPuff"))
        assert new == pytest.approx(spoken[name] if is_mouth else old)
    assert after["values"][52:] == before["values"][52:]


PACKETS = (
    next(
        bundle_messages(
            [encode_message("/VMC/Ext/Blend/Val", "A", 0.5), encode_message("/VMC/Ext/Blend/Apply")]
        )
    ),
    LIVE_LINK.encode_at(MOUTH_FRAME, 0.0),
)


@given(
    st.binary(max_size=300)
    | st.tuples(st.sampled_from(PACKETS), st.integers(0, 400), st.binary(max_size=8)).map(
        lambda parts: parts[0][: parts[1]] + parts[2] + parts[0][parts[1] + len(parts[2]) :]
    )
)
def test_malformed_packets_are_dropped(packet: bytes) -> None:
    for connection in (VMC, LIVE_LINK):
        try:
            packets, _ = connection.with_mouth(packet, MOUTH_FRAME)
        except ValueError:
            continue
        assert sum(map(len, packets)) < len(packet) + 20_000


def test_packets_that_cost_too_much_are_dropped() -> None:
    element = struct.pack(">i", 8) + b"/a\0\0,\0\0\0"
    header = b"#bundle\0" + bytes(8)
    with pytest.raises(ValueError, match="too many messages"):
        VMC.with_mouth(header + 5000 * element, MOUTH_FRAME)
    nested = b"/a\0\0,\0\0\0"
    for _ in range(1000):
        nested = header + struct.pack(">i", len(nested)) + nested
    with pytest.raises(ValueError, match="nested too deeply"):
        VMC.with_mouth(nested, MOUTH_FRAME)


@with_fake_time
async def test_a_flood_is_cut_and_bad_packets_do_not_count_as_a_face() -> None:
    forwarded: list[bytes] = []

    def forward(packet: bytes) -> bool:
        forwarded.append(packet)
        if packet == b"bad":
            raise ValueError("malformed")
        return True

    tracker = TrackerInput(forward)
    tracker.datagram_received(b"bad", None)
    assert not tracker.is_live
    for _ in range(2000):
        tracker.datagram_received(b"good", None)
    assert tracker.is_live
    assert len(forwarded) == 600


@with_fake_time
async def test_forwarded_packets_count_only_if_they_are_sent() -> None:
    connection = connection_to("vmc://?camera=39541")
    udp = mock.Mock()
    connection._socket = udp
    tracker = TrackerInput(connection._forward)
    connection._tracker_input = mock.Mock(), tracker
    (packet,) = bundle_messages([encode_message("/VMC/Ext/Blend/Apply")])
    assert connection.send(MOUTH_FRAME)
    tracker.datagram_received(packet, None)
    assert connection.send(MOUTH_FRAME)
    udp.send.side_effect = ConnectionRefusedError(errno.ECONNREFUSED, "refused")
    tracker.datagram_received(packet, None)
    assert not connection.send(MOUTH_FRAME)


@pytest.mark.parametrize("camera", ["0", "65536", "phone", "1.2.3.4:", "-1", "a..b:1"])
def test_rejects_an_invalid_address_of_a_tracker(camera: str) -> None:
    with pytest.raises(UserError, match="camera must be a port"):
        parse_target(f"vmc://?camera={camera}")


def test_only_local_trackers_may_be_started_from_a_page() -> None:
    assert parse_target("vmc://?camera=39541").is_local
    assert parse_target("vmc://?camera=[::1]:39541").tracker_address == ("::1", 39541)
    assert not parse_target("vmc://?camera=0.0.0.0:39541").is_local
