"""The synthesizer as a kind of service."""

from kouxing.shared.service_kind import ServiceKind

KIND = ServiceKind(
    name="synthesizer",
    role="worker",
    summary="Run a synthesizer: phones in, FAP frames out.",
    config="kouxing.services.synthesizer.config:SynthesizerConfig",
    service="kouxing.services.synthesizer.service:SynthesizerService",
    provides=("phone_input", "faps"),
)
