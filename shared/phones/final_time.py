"""Tracks the time up to which phones are final, where another recognizer can continue."""

from kouxing.shared.phones.events import Phone, Progress, SoundEvent, SpeechChange

QUIET_S = 0.5  # speech is reported within this time after the onset of its first phone


class FinalTimeTracker:
    """Tracks a session's events. No later phone starts before ``time_s``."""

    def __init__(self) -> None:
        # End of the last final phone, or last speech change; during silence, it follows the audio
        self.time_s = 0.0
        self._is_speaking = False

    def update(self, event: SoundEvent) -> None:
        """Process the next event."""
        time_s = 0.0
        if isinstance(event, SpeechChange):
            self._is_speaking, time_s = event.active, event.time_s
        elif isinstance(event, Phone) and event.final:
            time_s = event.onset_s + event.duration_s
        elif isinstance(event, Progress) and not self._is_speaking:
            time_s = event.time_s - QUIET_S
        self.time_s = max(self.time_s, time_s)
