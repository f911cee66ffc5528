"""The address of the page."""

import pytest

from kouxing.services.gateway.config import GatewayConfig
from kouxing.services.gateway.web.page_endpoint import make_page_endpoint

ANYWHERE = "0.0.0.0"  # noqa: S104


def test_the_page_is_at_the_address_that_reaches_control(monkeypatch: pytest.MonkeyPatch) -> None:
    def local_address(towards: str = "the internet") -> str:
        return {"10.0.0.1": "10.0.0.4", "the internet": "192.0.2.4"}[towards]

    monkeypatch.setattr("kouxing.shared.settings.config.local_address", local_address)
    for control, address in (("10.0.0.1", "10.0.0.4"), ("127.0.0.1", "192.0.2.4")):
        config = GatewayConfig(host=ANYWHERE, https="proxy", control=f"tcp://{control}:5550")
        assert make_page_endpoint(config, 8080).url.startswith(f"http://{address}:8080/#token=")
