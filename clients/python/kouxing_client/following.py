"""Which messages of a session count. Pure code, after "Following a session" of PROTOCOL.md."""

from __future__ import annotations

from kouxing_client.messages import END, PUBLISHER_OF, Fields

_FACES = ("fap-frame", "shapes")
_Number = tuple[int, int]  # epoch and sequence


class Order:
    """Takes every message once, through reconnections and moves.

    Parameters
    ----------
    epoch
        The session's when it is first followed; 0 if unknown.

    Attributes
    ----------
    has_ended
        Whether the last face has come.
    """

    def __init__(self, epoch: int) -> None:
        self.has_ended = False
        self._first_epoch = epoch
        self._epoch = epoch
        self._newest: dict[str, _Number] = {}  # by kind
        self._newest_before: dict[str, _Number] = {}  # when it was followed anew
        self._taken: set[tuple[str, _Number]] | None = None  # since then; None: they come one way
        self._epochs: dict[str, int] = {}  # by publisher
        self._last_face: dict[str, _Number] = {}  # media time and sequence, by kind

    def follow_anew(self) -> None:
        """From here on messages may come twice: by the old connection and by a new one."""
        self._newest_before, self._taken = dict(self._newest), set()

    def left_before(self) -> None:
        """From here on messages come by the new connection alone."""
        self._taken = None

    def takes(self, kind: str, fields: Fields) -> bool:
        """Return whether a message counts, and remember it."""
        publisher, epoch = PUBLISHER_OF[kind], fields["epoch"]
        source = f"{kind} {fields.get('set', '')}"
        known_epoch = self._epochs.get(publisher, self._first_epoch)
        if epoch < known_epoch or (kind == END and epoch < self._epoch):
            return False
        if epoch > self._epoch:
            self._epoch, self.has_ended = epoch, False
        number = (epoch, fields["sequence"])
        is_older = number <= self._newest_before.get(source, (-1, -1))
        if is_older or (source, number) in (self._taken or ()):
            return False
        if self._taken is not None:
            self._taken.add((source, number))
        self._epochs[publisher] = epoch
        self._newest[source] = max(number, self._newest.get(source, number))
        if kind in _FACES:
            place = (fields["media_time"], fields["sequence"])
            if place <= self._last_face.get(source, (-1, -1)):
                return False
            self._last_face[source] = place
        self.has_ended = self.has_ended or kind == END
        return True
