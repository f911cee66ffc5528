"""The recognizer as a kind of service."""

from kouxing.shared.service_kind import ServiceKind

KIND = ServiceKind(
    name="recognizer",
    role="worker",
    summary="Run a recognizer: audio in, phones with times out.",
    config="kouxing.services.recognizer.config:RecognizerConfig",
    service="kouxing.services.recognizer.service:RecognizerService",
    provides=("audio", "unpaced_audio", "phones"),
    needs=("phone_input",),
)
