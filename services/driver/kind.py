"""Declares the driver as a kind of service."""

from kouxing.shared.service_kind import ServiceKind

KIND = ServiceKind(
    name="driver",
    role="observer",
    summary="Run a driver: FAP frames in, a window and videos out.",
    config="kouxing.services.driver.config:DriverConfig",
    service="kouxing.services.driver.service:DriverService",
    needs=("phones", "faps"),
)
