"""The recordings of a corpus with aligned phones and speaking rates.

The speaking rate is the number of syllables per second of phones, without pauses.
"""

from bisect import bisect
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from rich.progress import track

from kouxing.corpora.feature_cache import read_audio
from kouxing.corpora.speech_corpus import RowErrors, Utterance, read_corpus, syllables_of
from kouxing.evaluation.recognizer.synthetic_sounds import Samples
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.offline.alignment import align_syllables, drop_pauses
from kouxing.shared.command.terminal import CONSOLE, print_message
from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import Phone

_RATES = (4.0, 5.5, 7.0)  # limits of the classes of speaking rates, syllables per second
RATE_NAMES = (
    f"below {_RATES[0]:g}/s",
    *(f"{low:g} to {high:g}/s" for low, high in pairwise(_RATES)),
    f"above {_RATES[-1]:g}/s",
)


@dataclass(frozen=True, slots=True)
class AlignedRecording:
    """A recording of a corpus and the aligned phones of its text, without silence."""

    utterance: Utterance
    phones: list[Phone]

    def read_audio(self) -> Samples:
        """Read the recording, 16 kHz mono."""
        return read_audio(self.utterance.path)

    @property
    def group(self) -> str:
        """The class of the speaking rate, or the language in a corpus of several languages."""
        if self.utterance.language:
            return f"language {self.utterance.language}"
        seconds = sum(phone.duration_s for phone in self.phones)
        return RATE_NAMES[bisect(_RATES, len(self.utterance.syllables) / seconds)]


def align_corpus(
    model: AcousticModel, corpus: Path, split: str, audio: Path | None = None
) -> list[AlignedRecording]:
    """Align the recordings of one split of a corpus in the model's language.

    Prints the rows that cannot be used. Raises ``UserError`` if the split has no usable recording.
    """
    references, errors = [], RowErrors()
    utterances = read_corpus(corpus, errors, model.inventory, split=split, audio=audio)
    for utterance in track(utterances, f"aligning {split}", console=CONSOLE, transient=True):
        try:
            samples = read_audio(utterance.path)
            syllables = syllables_of(utterance, model.inventory)
            phones = align_syllables(model, samples, syllables).phones
        except UserError as error:
            errors.add(utterance.utterance_id, str(error))
            continue
        references.append(AlignedRecording(utterance, drop_pauses(phones, model.inventory)))
    if not references:
        raise errors.no_recording_error(f"in the split {split!r} of {corpus}")
    errors.report_to(print_message)
    return references
