"""Clients of control wait longer than control needs."""

import inspect

from kouxing_client import AsyncClient, Client

from kouxing.services.control.restart_recovery import RECOVERY_S
from kouxing.services.control.session_lifecycle import START_TIMEOUT_S
from kouxing.services.gateway.audio.audio_sessions import CONTROL_TIMEOUT_S


def test_clients_wait_until_control_has_opened_or_rejected_a_session() -> None:
    defaults = [
        inspect.signature(client).parameters["timeout_s"].default
        for client in (Client, AsyncClient)
    ]
    assert min(CONTROL_TIMEOUT_S, *defaults) > 1.5 * max(START_TIMEOUT_S, RECOVERY_S)
