"""The time up to which a session's phones are final, from which another recognizer may continue."""

from kouxing.shared.phones.events import Phone, Progress, SoundEvent, SpeechChange

QUIET_S = 0.5  # the start of speech is reported sooner after its first phone's onset than this


class FinalTime:
    """Follows a session's events; no later phone starts before ``time_s``."""

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
