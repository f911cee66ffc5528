"""The gateway as a kind of service."""

from kouxing.shared.service_kind import ServiceKind

KIND = ServiceKind(
    name="gateway",
    role="observer",
    summary="Run the gateway: the face and a microphone in a browser.",
    config="kouxing.services.gateway.config:GatewayConfig",
    service="kouxing.services.gateway.service:GatewayService",
    needs=("phones", "faps"),
    client_roles=("client",),
)
