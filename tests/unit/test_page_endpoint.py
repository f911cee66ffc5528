"""The address of the page, and its host names."""

import pytest
from kouxing_client.field_types import MAX_ENDPOINT
from kouxing_client.messages import Message

from kouxing.services.gateway.config import GatewayConfig
from kouxing.services.gateway.web.page_endpoint import make_page_endpoint
from kouxing.services.service_kinds import CONFIG_TYPES
from kouxing.shared.errors import UserError
from kouxing.shared.fast_record import replace
from kouxing.shared.settings.config import Settings
from kouxing.shared.wire.codec import decode, encode
from tests.samples import SAMPLES

ANYWHERE = "0.0.0.0"  # noqa: S104


def test_the_page_is_at_the_address_that_reaches_control(monkeypatch: pytest.MonkeyPatch) -> None:
    def local_address(towards: str = "the internet") -> str:
        return {"10.0.0.1": "10.0.0.4", "the internet": "192.0.2.4"}[towards]

    monkeypatch.setattr("kouxing.shared.settings.config.local_address", local_address)
    for control, address in (("10.0.0.1", "10.0.0.4"), ("127.0.0.1", "192.0.2.4")):
        config = GatewayConfig(host=ANYWHERE, https="proxy", control=f"tcp://{control}:5550")
        assert make_page_endpoint(config, 8080).url.startswith(f"http://{address}:8080/#token=")


def test_the_url_fits_into_a_message() -> None:
    def heartbeat(token: str) -> Message:
        url = make_page_endpoint(GatewayConfig(token=token), 8080).url
        return replace(SAMPLES["heartbeat"], endpoints={"page": url})

    longest = (MAX_ENDPOINT - len("http://127.0.0.1:8080/#token=")) * "t"
    assert decode(encode(heartbeat(longest))) == heartbeat(longest)
    for token in (longest + "t", 30 * "口"):  # each has 9 characters in a URL
        with pytest.raises(UserError, match=r"gateway\.token: .* use a shorter token"):
            heartbeat(token)


@pytest.mark.parametrize(
    ("local_name", "names"),
    [
        ("DESKTOP-Ab1", {"desktop-ab1", "desktop-ab1.local", "face.example.org"}),
        ("Johns-Mac.local", {"johns-mac", "johns-mac.local", "face.example.org"}),
    ],
)
def test_host_names_may_have_capital_letters(
    local_name: str, names: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("socket.gethostname", lambda: local_name)
    endpoint = make_page_endpoint(GatewayConfig(names=("Face.example.org",)), 8080)
    others = {"johns-mac.local.local", "evil.example"}
    assert {name for name in names | others if endpoint.access.is_gateway_host(name)} == names


def test_trusted_origins_may_have_capital_letters() -> None:
    assignments = {"gateway.trusted_origins": "https://Face.example.org:8443"}
    config = Settings(CONFIG_TYPES, environment={}, assignments=assignments).load(GatewayConfig)
    assert config.trusted_origins == ("https://face.example.org:8443",)
