"""Tracks the time up to which phones are final, where another recognizer can continue."""

from kouxing_client.messages import Message, Phone, Speech

from kouxing.shared.clock import to_samples
from kouxing.shared.wire.speech import AudioState, Progress

MAX_REPORT_DELAY_SAMPLES = to_samples(0.5)  # from the onset of a first phone to its ``speech``


class FinalTimeTracker:
    """Tracks a session's results. No later phone starts before ``media_time``."""

    def __init__(self) -> None:
        # End of the last final phone, or last speech change; during silence, it follows the audio
        self.media_time = 0
        self._is_speaking = False

    def update(self, message: Message) -> None:
        """Process the next message of the recognizer."""
        final_until = 0
        match message:
            case Speech():
                self._is_speaking, final_until = message.active, message.media_time
            case Phone(final=True):
                final_until = message.media_time + message.duration
            case Progress(state=AudioState.RUNNING) if not self._is_speaking:
                final_until = message.media_time - MAX_REPORT_DELAY_SAMPLES
        self.media_time = max(self.media_time, final_until)
