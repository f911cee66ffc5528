"""A viewer's queue stays short, and what is left in it is new."""

from __future__ import annotations

import asyncio

import pytest

from kouxing.services.gateway.outbox import MAX_WAITING, NUM_FRAMES_KEPT, Kind, Outbox

pytestmark = pytest.mark.unit


def drain(outbox: Outbox) -> list[str | bytes]:
    async def take() -> list[str | bytes]:
        return [await outbox.get() for _ in range(len(outbox))]

    return asyncio.run(take())


def test_messages_keep_their_order() -> None:
    outbox = Outbox()
    dropped = [
        outbox.put(Kind.TEXT, "session"),
        outbox.put(Kind.SOUND, b"s"),
        outbox.put(Kind.FRAME, b"f"),
    ]

    assert drain(outbox) == ["session", b"s", b"f"]
    assert dropped == [0, 0, 0]


def test_a_slow_viewer_gets_the_newest_frames_and_all_recent_text() -> None:
    outbox = Outbox()
    outbox.put(Kind.TEXT, "session")
    num_dropped = 0
    for number in range(MAX_WAITING):
        num_dropped += outbox.put(Kind.SOUND if number % 2 else Kind.FRAME, b"%d" % number)

    left = drain(outbox)
    assert left[0] == "session"
    assert len(left) == 1 + NUM_FRAMES_KEPT
    assert left[-1] == b"%d" % (MAX_WAITING - 2)  # the newest frame
    assert num_dropped == MAX_WAITING - NUM_FRAMES_KEPT


def test_faces_at_rest_take_no_room_from_those_of_a_session() -> None:
    outbox = Outbox()
    for number in range(MAX_WAITING // 2):
        outbox.put(Kind.FRAME, b"frame %d" % number)
        outbox.put(Kind.REST, b"rest %d" % number)
    outbox.put(Kind.TEXT, "one too many")

    newest = range(MAX_WAITING // 2 - NUM_FRAMES_KEPT, MAX_WAITING // 2)
    frames = [b"frame %d" % number for number in newest]
    assert drain(outbox) == [*frames, b"rest %d" % newest[-1], "one too many"]


def test_it_never_grows_without_bound() -> None:
    outbox = Outbox()
    for number in range(10 * MAX_WAITING):
        outbox.put(Kind.TEXT, str(number))
        assert len(outbox) <= MAX_WAITING

    assert drain(outbox)[-1] == str(10 * MAX_WAITING - 1)


def test_a_reader_waits_for_the_next_message() -> None:
    async def read() -> str | bytes:
        outbox = Outbox()
        reader = asyncio.ensure_future(outbox.get())
        await asyncio.sleep(0)
        assert not reader.done()
        outbox.put(Kind.TEXT, "late")
        return await reader

    assert asyncio.run(read()) == "late"
