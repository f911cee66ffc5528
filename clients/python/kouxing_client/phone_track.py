"""Joins the phones of successive recognizers into one sequence, without I/O."""

from collections.abc import Iterable, Iterator

from msgspec.structs import replace

from kouxing_client.messages import SILENCE, Phone, Speech

_TOLERANCE_SAMPLES = 160


class PhoneTrack:
    """Returns each phone of a session once, even if several recognizers publish it.

    A recognizer that takes over a session renumbers its phones, and may repeat phones. The track
    continues the numbering and drops repeated phones. ``num_missed`` counts final phones that were
    published but did not arrive. It is computed from gaps in their numbers and times.
    """

    def __init__(self) -> None:
        self.num_missed = 0
        self._epoch = 0  # epoch of the newest phone
        self._base = 0  # added to the recognizer's indices
        self._next = 0  # the greatest index plus one
        self._open: dict[int, Phone] = {}  # phones that are not final, by index
        self._next_final: int | None = None  # the recognizer's index of its next final phone
        self._end = 0  # media time at which the last final phone ends
        self._is_speaking = False
        self._speech_time = 0  # media time at which `_is_speaking` last changed

    def add_speech(self, speech: Speech) -> list[Phone]:
        """Process a start or end of speech; return the phones that change.

        The first message of another recognizer has the time at which it resumes.
        """
        changed: list[Phone] = []
        if speech.sequence == 1:
            known = max(self._end, self._speech_time) + _TOLERANCE_SAMPLES
            is_voiced = self._is_speaking or speech.active
            if self._epoch and is_voiced and speech.media_time > known:
                self.num_missed += 1  # one or more
            changed = self._restart()
        self._is_speaking, self._speech_time = speech.active, speech.media_time
        return changed

    def _restart(self) -> list[Phone]:
        """Continue with another recognizer; return the open phones as withdrawn."""
        withdrawn = [_withdraw(phone) for phone in self._open.values()]
        self._open.clear()
        self._base, self._next_final = self._next, None
        return withdrawn

    def update(self, phone: Phone) -> list[Phone]:
        """Add or revise a phone; return the phones that change."""
        changed: list[Phone] = []
        if phone.epoch > self._epoch and phone.index < (self._next_final or 0):
            self.num_missed += 1  # one or more of the other recognizer's first messages
            changed = self._restart()
        self._epoch = phone.epoch
        if phone.final:
            first = phone.index if self._next_final is None else self._next_final
            changed += self._skip(range(self._base + first, self._base + phone.index))
            self._next_final = phone.index + 1
        phone = replace(phone, index=self._base + phone.index)
        was_open = self._open.pop(phone.index, None) is not None
        is_new = phone.media_time + phone.duration // 2 >= self._end
        if phone.final:
            self._end = max(self._end, phone.media_time + phone.duration)
        if not is_new and not (phone.final and was_open):
            return changed
        self._next = max(self._next, phone.index + 1)
        if not phone.final:
            self._open[phone.index] = phone
        return [*changed, phone if is_new else _withdraw(phone)]

    def _skip(self, indices: Iterable[int]) -> Iterator[Phone]:
        """Withdraw phones that an interruption dropped; count those that never arrived."""
        for index in indices:
            if index in self._open:
                yield _withdraw(self._open.pop(index))
            else:
                self.num_missed += 1


def _withdraw(phone: Phone) -> Phone:
    return replace(phone, symbol=SILENCE, duration=0, final=True)
