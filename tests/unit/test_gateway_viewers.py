"""Messages that viewers of the gateway get, and their bounded queues."""

import asyncio
from typing import Any

import numpy as np

from kouxing.services.gateway import wire
from kouxing.services.gateway.http import WebSockets
from kouxing.services.gateway.sample import SampleSentence
from kouxing.services.gateway.viewer_queue import (
    MAX_QUEUED,
    NUM_FRAMES_KEPT,
    MessageKind,
    ViewerQueue,
)
from kouxing.services.gateway.viewers import PAUSE_S, Viewer, Viewers
from kouxing.shared.face.idle_motion import RestingFace
from kouxing.shared.metrics import Metrics

UNUSED: Any = lambda *_: None  # noqa: E731 - calls that these tests do not need


def binary_types(viewer: Viewer) -> list[int]:
    """Return the types of the queued binary messages."""

    async def take_all() -> list[str | bytes]:
        return [await viewer.queue.get() for _ in range(len(viewer.queue))]

    return [message[0] for message in asyncio.run(take_all()) if isinstance(message, bytes)]


def test_a_viewer_that_joins_a_moving_face_gets_the_face_at_rest_once() -> None:
    viewers = Viewers(WebSockets(), 1.0, Metrics(), SampleSentence(UNUSED), UNUSED, UNUSED)
    face = RestingFace(seed=0)
    frame = np.zeros(68, "<f4").tobytes()
    viewers.add_session("talk", 1, "learnt")
    with viewers.connected("", None) as viewer:
        viewers.show_frame("talk", 1, 0, frame, now_s=0.0)
        assert viewers.rest_from_s < 0
        viewers.show_rest(face, now_s=0.01)
        assert binary_types(viewer) == [wire.FAP_TYPE, wire.REST_TYPE]
        viewers.show_frame("talk", 1, 1, frame, now_s=0.02)
        viewers.show_rest(face, now_s=0.1)
        assert binary_types(viewer) == [wire.FAP_TYPE]
        assert viewers.rest_from_s == 0.02 + PAUSE_S
        viewers.show_rest(face, now_s=0.5)
        assert binary_types(viewer) == [wire.REST_TYPE]


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
