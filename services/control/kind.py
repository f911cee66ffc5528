"""Control as a kind of service."""

from kouxing.shared.service_kind import ServiceKind

KIND = ServiceKind(
    name="control",
    role="control",
    summary="Run control: it opens sessions and places them on the other services.",
    config="kouxing.services.control.config:ControlConfig",
    service="kouxing.services.control.service:ControlService",
)
