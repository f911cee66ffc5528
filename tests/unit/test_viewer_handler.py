"""Commands of viewers, without a browser."""

import asyncio
import json
from typing import Any, cast

import pytest

from kouxing.services.gateway.viewers.viewer_handler import Viewer, ViewerHandler
from kouxing.services.gateway.web.web_application import OpenWebSockets
from kouxing.shared.monitoring.metrics import Metrics
from kouxing.shared.wire.face import FaceSettings


class NoSample:
    """A sample sentence that is not played."""

    session, open_sessions = "", ()


async def errors_of(viewer: Viewer) -> list[str]:
    """Return the texts of a viewer's queued errors."""
    queued = [await viewer.queue.get() for _ in range(len(viewer.queue))]
    messages = [json.loads(message) for message in queued if isinstance(message, str)]
    return [message["text"] for message in messages if message["type"] == "error"]


@pytest.mark.parametrize(("language", "is_accepted"), [("zh", True), ("en", False), ("", False)])
def test_only_a_session_in_mandarin_can_use_the_light_model(
    language: str, is_accepted: bool
) -> None:
    changes: list[str] = []
    handler = ViewerHandler(
        OpenWebSockets(),
        1.0,
        Metrics(),
        cast(Any, NoSample()),
        lambda session, _: changes.append(session),
        lambda: None,
    )
    handler.add_session("s", 1, FaceSettings(), language)
    with handler.connect_viewer("s", None) as viewer:
        handler.handle_command(viewer, json.dumps({"acoustic": "full"}))
        handler.handle_command(viewer, json.dumps({"acoustic": "light"}))
        errors = asyncio.run(errors_of(viewer))
    assert len(changes) == 1 + is_accepted
    assert errors == [] if is_accepted else "only Mandarin" in errors[0]
