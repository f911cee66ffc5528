"""The spoken form of a text: syllables with their spelling, and the parts that cannot be read."""

from dataclasses import dataclass

from kouxing.shared.fast_record import Record


@dataclass(frozen=True, slots=True)
class SpokenSyllable:
    """A syllable of a text."""

    text: str  # as written: a character, or the syllable
    spelling: str  # with its tone, such as "ni3"
    phones: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Transcript:
    """A text, syllable by syllable."""

    syllables: tuple[SpokenSyllable, ...]
    dropped: tuple[str, ...] = ()  # parts of the text that cannot be read

    @property
    def phones(self) -> list[tuple[str, ...]]:
        """The phones of each syllable."""
        return [syllable.phones for syllable in self.syllables]


class TimedSyllable(Record, frozen=True):
    """A syllable of a text and when it is spoken."""

    text: str
    spelling: str
    onset_s: float
    duration_s: float

    @property
    def end_s(self) -> float:
        """Seconds from the start of the recording."""
        return self.onset_s + self.duration_s
