"""The registry of service kinds: every entry leads to a service that runs on its own."""

from __future__ import annotations

import importlib.util
import pkgutil

import pytest

from services.kinds import KINDS, ServiceKind
from shared.config import ServiceConfig
from shared.service import Service

pytestmark = pytest.mark.unit


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
def test_an_entry_leads_to_its_classes_and_its_module(kind: ServiceKind) -> None:
    service = pkgutil.resolve_name(kind.service)
    assert issubclass(service, Service)
    assert service.name == kind.name
    assert issubclass(kind.config_type, ServiceConfig)
    assert importlib.util.find_spec(f"services.{kind.name}.__main__")


def test_control_starts_first() -> None:
    assert next(iter(KINDS)) == "control"
