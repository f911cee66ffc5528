"""The queue of one viewer is bounded and favors new messages."""

import asyncio

from kouxing.services.gateway.viewer_queue import (
    MAX_QUEUED,
    NUM_FRAMES_KEPT,
    MessageKind,
    ViewerQueue,
)


def drain(viewer_queue: ViewerQueue) -> list[str | bytes]:
    async def take_all() -> list[str | bytes]:
        return [await viewer_queue.get() for _ in range(len(viewer_queue))]

    return asyncio.run(take_all())


def test_drops_sound_and_old_frames_but_not_text() -> None:
    queue = ViewerQueue()
    queue.put(MessageKind.TEXT, "session")
    num_dropped = 0
    for number in range(MAX_QUEUED):
        kind = MessageKind.SOUND if number % 2 else MessageKind.FRAME
        num_dropped += queue.put(kind, b"%d" % number)

    left = drain(queue)
    assert left[0] == "session"
    assert len(left) == 1 + NUM_FRAMES_KEPT
    assert left[-1] == b"%d" % (MAX_QUEUED - 2)  # the newest frame
    assert num_dropped == MAX_QUEUED - NUM_FRAMES_KEPT


def test_text_cannot_exceed_the_limit() -> None:
    queue = ViewerQueue()
    for number in range(2 * MAX_QUEUED):
        queue.put(MessageKind.TEXT, str(number))
        assert len(queue) <= MAX_QUEUED
    assert drain(queue)[-1] == str(2 * MAX_QUEUED - 1)
