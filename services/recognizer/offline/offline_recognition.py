"""Recognizes whole recordings with the same search as live audio."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.live.recognizer import Recognizer
from kouxing.shared.arrays import Floats
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.fast_record import replace
from kouxing.shared.phones.events import Phone

WithProgress: TypeAlias = Callable[[Sequence[Any]], Iterable[Any]]  # ``iter``, or a progress bar


def recognize_recording(
    model: AcousticModel, samples: Floats, with_progress: WithProgress = iter
) -> list[Phone]:
    """Return the phones of a recording, 16 kHz mono, (n,), and silence within speech.

    A live session with the same audio has the same final phones. ``with_progress`` wraps the loop
    to show progress.
    """
    recognizer = Recognizer(model)
    stream = recognizer.create_stream()
    phones: list[Phone] = []

    def decode() -> None:
        recognizer.decode_streams([stream])
        for result in stream.take_results():
            if isinstance(result, Phone) and result.final and not result.is_withdrawn:
                phones.append(replace(result, index=len(phones)))

    for start in with_progress(range(0, len(samples), MEDIA_RATE_HZ)):
        stream.accept_waveform(samples[start : start + MEDIA_RATE_HZ])
        decode()
    stream.input_finished()
    decode()
    return phones
