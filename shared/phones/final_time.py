"""Up to where a session's phones are final, so that another recognizer may go on from there."""

from __future__ import annotations

from kouxing.shared.phones.events import Phone, Progress, SoundEvent, SpeechChange

QUIET_S = 0.5  # speech that begins is told sooner after its first phone's onset


class FinalTime:
    """Follows a session's sound events; no phone that is still to come begins before ``time_s``.

    Attributes
    ----------
    time_s : float
        End of the last final phone or time of the last change of speech, seconds of media time;
        while nobody speaks, it follows the sound.
    """

    def __init__(self) -> None:
        self.time_s = 0.0
        self._is_speaking = False

    def accept(self, event: SoundEvent) -> None:
        """Take the next event."""
        time_s = 0.0
        if isinstance(event, SpeechChange):
            self._is_speaking, time_s = event.active, event.time_s
        elif isinstance(event, Phone) and event.final:
            time_s = event.onset_s + event.duration_s
        elif isinstance(event, Progress) and not self._is_speaking:
            time_s = event.time_s - QUIET_S
        self.time_s = max(self.time_s, time_s)
